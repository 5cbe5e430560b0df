"""Optimised grasps of whole rows: what stays, what the indices mean, independence of the batch."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from lgrasp.geometry.poses import device_matrix
from lgrasp.hand.arrays import body_poses, upload_hand
from lgrasp.hand.model import HandModel
from lgrasp.hand.opposition.spaces import hand_spaces, spaces_view
from lgrasp.object.params import ObjectParams
from lgrasp.object.preprocess import preprocess_object
from lgrasp.runtime.streams import uniforms
from lgrasp.sequence.optimiser.optimise import Optimised, optimise, start_poses
from lgrasp.sequence.optimiser.params import OptimiserParams

SHORT = OptimiserParams(
    iterations=200,
    w_fc=5,
    step=0.01,
    step_period=25,
    temperature=8,
    temperature_period=6,
    hand_points=512,
    object_points=256,
)
SPACES = ["thumb-palm", "index-middle", "ring-palm"]


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Busy machines: threads that wait for one another cost more than they gain on arrays so small."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def case(inputs) -> SimpleNamespace:
    """Allegro with three of its spaces, a ball and a bar."""
    source = inputs.keys.source
    model = spaces_view(source.urdf, source.spec, inputs.hand.model, SPACES)
    known = {s.name: s for s in hand_spaces(source.spec, model.tree)}
    params = ObjectParams(sdf_cells=40**3, obstacle_count=1024, contact_count=512)
    shapes = [trimesh.creation.icosphere(3, 0.03), trimesh.creation.box((0.03, 0.02, 0.07))]
    return SimpleNamespace(
        hand=model,
        spaces=[known[name] for name in SPACES],
        objects=[preprocess_object(mesh, params=params) for mesh in shapes],
    )


@pytest.fixture(scope="module")
def first(case) -> Optimised:
    """Balls grasped by the first two spaces."""
    return run(case, 1, np.arange(6) % 2, method="anneal")


def rows_of(case, number: int, space: np.ndarray, before: Optimised | None = None) -> dict[str, np.ndarray]:
    n = len(space)
    free = np.array([case.spaces[s].joints for s in space])
    opened = np.tile(case.hand.tree.joint_open, (n, 1))
    held = np.zeros((n, 0, 7), np.float32)
    q, held = (opened, held) if before is None else (before.q, before.pose[:, None])
    return {"space": space, "free": free, "q": q, "held": held, "seed": 100 * number + np.arange(n)}


def run(case, number: int, space: np.ndarray, before: Optimised | None = None, only=slice(None), **more) -> Optimised:
    """Grasp object ``number`` in rows of these spaces that hold what ``before`` grasped."""
    params = OptimiserParams(iterations=12, step_period=4, temperature_period=3, hand_points=512, object_points=256)
    inputs = {name: values[only] for name, values in rows_of(case, number, space, before).items()}
    return optimise(case.hand, case.spaces, case.objects[:number], **inputs, **{"params": params} | more)


def points_of(hand: HandModel, space: int, group: int) -> np.ndarray:
    """Contact points of a side of a space."""
    run = hand.contact_run(space, group)
    return np.arange(*hand.contact_first[run : run + 2])


def columns(result: Optimised) -> list[np.ndarray]:
    return [result.pose, result.q, result.hand_point, result.object_point, result.energies]


@pytest.mark.parametrize(("method", "number"), [("anneal", 2), ("mala", 1)])
def test_rows_do_not_depend_on_the_batch(case, first, method, number):
    """Bit by bit: all together, in blocks, alone."""
    space = np.array([0, 1, 0, 1, 0, 1]) if number == 1 else np.full(6, 2)
    before = None if number == 1 else first
    together = run(case, number, space, before, method=method)
    blocks = run(case, number, space, before, method=method, rows=4)
    assert all(np.array_equal(a, b) for a, b in zip(columns(together), columns(blocks), strict=True))
    alone = run(case, number, space, before, slice(2, 3), method=method)
    assert all(np.array_equal(a[0], b[2]) for a, b in zip(columns(alone), columns(together), strict=True))


def test_joints_that_may_not_move_stay_bit_by_bit(case, first):
    space = np.full(6, 2)
    second = run(case, 2, space, first)
    free = case.spaces[2].joints
    assert np.array_equal(second.q[:, ~free], first.q[:, ~free])
    assert (second.q[:, free] != first.q[:, free]).any(1).all()
    assert (second.q >= case.hand.tree.joint_lower).all()
    assert (second.q <= case.hand.tree.joint_upper).all()


def test_indices_name_points_of_the_two_sides_and_the_nearest_of_the_object(case, first):
    T_body = device_matrix(body_poses(upload_hand(case.hand, "cpu"), first.q).astype(float).reshape(-1, 7))
    T_body = T_body.reshape(len(first.q), -1, 4, 4)
    surface = case.objects[0].contact_points
    for row, space in enumerate(np.arange(6) % 2):
        view = case.hand
        for side, group in enumerate(case.spaces[space].groups):
            index = first.hand_point[row, side]
            assert index in points_of(view, space, group)
            T = T_body[row, view.contact_body[index]]
            p = T[:3, :3] @ view.contact_points[index] + T[:3, 3]
            local = Rotation.from_quat(first.pose[row, 3:]).inv().apply(p - first.pose[row, :3])
            distance = np.linalg.norm(surface - local, axis=1)
            assert distance[first.object_point[row, side]] == pytest.approx(distance.min(), abs=1e-6)


def test_distances_are_those_of_the_contact_points(case, first):
    """dis from the pose, the posture and the indices alone, on a true ball."""
    T_body = device_matrix(body_poses(upload_hand(case.hand, "cpu"), first.q).astype(float).reshape(-1, 7))
    T_body = T_body.reshape(len(first.q), -1, 4, 4)
    for row in range(6):
        gaps = []
        for index in first.hand_point[row]:
            T = T_body[row, case.hand.contact_body[index]]
            p = T[:3, :3] @ case.hand.contact_points[index] + T[:3, 3]
            gaps.append(abs(np.linalg.norm(p - first.pose[row, :3]) - 0.03))
        assert first.energies[row, 1] <= sum(gaps) + 1e-3  # far from a grid its distance is a lower bound


@pytest.fixture(scope="module")
def longer(case) -> Optimised:
    """A longer search."""
    return run(case, 1, np.ones(6, int), params=SHORT)


def test_more_steps_lower_the_energy(case, longer):
    """A short schedule: contacts come near and oppose each other."""
    brief = run(case, 1, np.ones(6, int), params=SHORT.model_copy(update={"iterations": 1}))
    assert np.median(longer.energies[:, 1]) < 0.5 * np.median(brief.energies[:, 1])
    assert np.median(longer.energies[:, 0]) < 0.5 * np.median(brief.energies[:, 0])


def test_touching_points_are_among_the_best_pairs(case, longer):
    """Where a grasp touches: among the best hundredth of all pairs by gap, angle of normals and balance."""
    touching = np.flatnonzero(longer.energies[:, 1] < 0.004)
    assert len(touching)
    view, (first, second) = case.hand, case.spaces[1].groups
    ball = case.objects[0]
    T_body = device_matrix(body_poses(upload_hand(case.hand, "cpu"), longer.q).astype(float).reshape(-1, 7))
    T_body = T_body.reshape(len(longer.q), -1, 4, 4)
    radius = np.linalg.norm(ball.obstacle_points - ball.com, axis=1).max()
    for row in touching:
        badness, arms, outward, sides = [], [], [], []
        for group in (first, second):
            own = points_of(view, 1, group)
            T = T_body[row, view.contact_body[own]]
            p = np.einsum("nij,nj->ni", T[:, :3, :3], view.contact_points[own]) + T[:, :3, 3]
            d = p - longer.pose[row, :3]
            n = d / np.linalg.norm(d, axis=1)[:, None]
            facing = np.einsum("nij,nj,ni->n", T[:, :3, :3], view.contact_normals[own], n)
            gap = np.abs(np.linalg.norm(d, axis=1) - 0.03)
            badness.append(gap / 0.002 + (1 + facing) / (1 - np.cos(np.radians(20))))
            arms.append(d / radius)
            outward.append(n)
            sides.append(own)
        force = outward[0][:, None] + outward[1]
        torque = np.cross(arms[0], outward[0])[:, None] + np.cross(arms[1], outward[1])
        total = badness[0][:, None] + badness[1] + ((force**2).sum(-1) + (torque**2).sum(-1)) / 0.1
        chosen = total[tuple(np.searchsorted(own, k) for own, k in zip(sides, longer.hand_point[row], strict=True))]
        assert chosen <= np.quantile(total, 0.01)


def test_starts_face_the_hand_and_clear_what_is_held(case):
    u = uniforms(torch.arange(300), 0, 7)
    none = torch.zeros(300, 0, 3, 3), torch.zeros(300, 0, 3)
    R, t = (x.numpy() for x in start_poses(case.hand, case.objects[1:], none, u))
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-9)
    # some point of the bar is in the canonical box, and none is much nearer to the palm, which faces about +x
    bar = case.objects[1]
    low, high = case.hand.canonical_box
    hull = np.array([(bar.vertices - bar.center) @ r.T + x for r, x in zip(R, t, strict=True)])  # (300, v, 3)
    assert (hull[..., 0].min(1) >= low[0] - 0.006).all()
    assert (hull[..., 0].min(1) <= high[0] + 0.006).all()
    held = torch.eye(3).expand(300, 1, 3, 3), torch.tensor([[0.1, 0.0, 0.02]]).expand(300, 1, 3)
    R, t = (x.numpy() for x in start_poses(case.hand, case.objects, held, u))
    hull = np.array([(bar.vertices - bar.center) @ r.T + x for r, x in zip(R, t, strict=True)])
    assert (hull[..., 0].min(1) >= 0.1 + 0.024).all()
