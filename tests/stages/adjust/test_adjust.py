"""adjust: object and fingers move together; a case in closed form, and contacts of a hand measured on its solids."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from lgrasp.engine.batch import run_stages
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.shard import shard_context
from lgrasp.errors import ConfigError
from lgrasp.grasp.tables import ContactSets
from lgrasp.jobs.hands import for_hand
from lgrasp.math.limits import DOF_SIZES, MAX_DOFS
from lgrasp.stages.adjust import stage
from lgrasp.stages.adjust.motion import ROWS, add_distance, add_offset, add_turn, solve_motion, vec6
from lgrasp.stages.adjust.params import AdjustParams
from lgrasp.stages.adjust.stage import run

EXACT = AdjustParams(gap=2e-5, angle=3, iterations=60, patience=60, contact_indentation=0.0)


def ball_between(context, pose, q):
    """A set of two contacts: each jaw on the end of the ball that faces it when the pose is a move alone."""
    model, groups = context.hand.model, context.hand.model.groups
    record, surface = np.zeros((1, groups, 1), np.int32), np.zeros((1, groups, 1), np.int32)
    owner = model.tree.body_group[model.contact_body]
    for g in range(groups):
        inward = -np.sign(model.contact_points[owner == g, 0].mean())
        inner = np.flatnonzero((owner == g) & (inward * model.contact_normals[:, 0] > 0.99))
        record[0, g, 0] = np.flatnonzero(np.isin(context.field.model.point, inner))[0]
        surface[0, g, 0] = np.argmax(-inward * context.object.model.contact_normals[:, 0])
    posture = np.zeros((1, groups, 1, MAX_DOFS), np.float32)
    posture[..., 0] = q
    arrays = {name: np.array([value], np.int32) for name, value in {"index": 7, "setting": 0}.items()}
    arrays |= {name: np.array([-1], np.int32) for name in ("palm_point", "palm_surface", "resting")}
    arrays |= {"pose": pose[None].astype(np.float32), "anchor": np.full((1, groups), -1, np.int32)}
    arrays = {f"candidates.poses.{name}": values for name, values in arrays.items()}
    own = {"count": np.ones((1, groups), np.int32), "surface": surface, "record": record, "q": posture}
    own |= {"state": np.zeros((1, groups, 1), np.int32), "further": np.zeros((0, 0, 0, 4), np.int32)}
    arrays |= {f"candidates.{name}": values for name, values in own.items()}
    sets = {"pose": [0], "slot": [3], "chosen": [[0] * groups], "score": [0.1]}
    kinds = {"score": np.float32}
    arrays |= {name: np.array(values, kinds.get(name, np.int32)) for name, values in sets.items()}
    return ContactSets.of(arrays, context.device)


def test_jaws_close_on_a_ball_that_turns_to_face_them(jaws_and_ball):
    turned = Rotation.from_euler("yz", (20, -15), degrees=True)
    pose = np.concatenate([(0.004, 0.003, 0.06), turned.as_quat()])
    kept, counts = run(ball_between(jaws_and_ball, pose, 0.02), EXACT, jaws_and_ball)
    assert counts == {"tried": 1, "kept": 1}
    after = kept.arrays()
    assert (after["slot"][0], after["candidates.poses.index"][0]) == (3, 7)
    T = after["candidates.poses.pose"][0].astype(float)
    R = Rotation.from_quat(T[3:]).as_matrix()
    model, obj = jaws_and_ball.hand.model, jaws_and_ball.object.model
    for g in range(2):
        point = R @ obj.contact_points[after["candidates.surface"][0, g, 0]] + T[:3]
        normal = R @ obj.contact_normals[after["candidates.surface"][0, g, 0]]
        assert abs(normal[0]) > np.cos(np.radians(3.1))  # along x
        c = jaws_and_ball.field.model.point[after["candidates.record"][0, g, 0]]
        opening = -np.sign(model.contact_normals[c, 0]) * after["candidates.q"][0, g, 0, 0]
        assert point[0] == pytest.approx(model.contact_points[c, 0] + opening, abs=4e-5)


def test_sets_that_come_to_nothing_are_left_out(jaws_and_ball):
    far = np.array([0.0, 0.4, 0.06, 0, 0, 0, 1])
    kept, counts = run(ball_between(jaws_and_ball, far, 0.02), AdjustParams(patience=2), jaws_and_ball)
    assert counts == {"tried": 1, "kept": 0}
    assert len(kept) == 0


@wp.kernel
def _move(
    rows: wp.array(dtype=vec6),
    aims: wp.array(dtype=wp.vec3),
    arms: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    damping: wp.float32,
    lever: wp.float32,
    motion_out: wp.array(dtype=vec6),
):
    equations = wp.zeros(shape=(ROWS,), dtype=vec6)
    for k in range(rows.shape[0]):
        add_distance(equations, rows[k], aims[k][0], 0.5)
        add_offset(equations, arms[k], aims[k], 0.2)
        add_turn(equations, normals[k], aims[k], 0.3)
    motion_out[0] = solve_motion(equations, damping, lever)


def skew(a):
    """skew(a) b = a x b."""
    return np.cross(a, np.eye(3)).T


def test_equations_of_the_objects_motion(device):
    """Against dense least squares in float64."""
    rng = np.random.default_rng(0)
    rows, aims, arms, normals = rng.normal(size=(2, 6)), *rng.normal(size=(3, 2, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    damping, lever = 0.3, 0.5
    A, b = [np.sqrt(0.5) * rows], [np.sqrt(0.5) * aims[:, 0]]
    for k in range(2):
        A.append(np.sqrt(0.2) * np.hstack([np.eye(3), -skew(arms[k])]))
        b.append(np.sqrt(0.2) * aims[k])
        A.append(np.sqrt(0.3) * np.hstack([np.zeros((3, 3)), skew(normals[k])]))
        b.append(np.sqrt(0.3) * aims[k])
    A.append(np.sqrt(damping) * np.diag([1, 1, 1, lever, lever, lever]))
    b.append(np.zeros(6))
    want = np.linalg.lstsq(np.vstack(A), np.concatenate(b), rcond=None)[0]
    kinds = zip((rows, aims, arms, normals), (vec6, wp.vec3, wp.vec3, wp.vec3), strict=True)
    given = [wp.array(values, dtype=kind, device=device) for values, kind in kinds]
    out = wp.zeros(1, dtype=vec6, device=device)
    wp.launch(_move, 1, [*given, damping, lever], [out], device=device)
    np.testing.assert_allclose(out.numpy()[0], want, rtol=2e-4, atol=2e-5)


@pytest.fixture(scope="module")
def adjusting(swift):
    """The default pipeline as it is for hands of few joints, on a small field."""
    return load_pipeline("robust").without("ik").model_copy(update={"field": swift.field})


def test_contacts_of_a_hand(adjusting, inputs, link_distance, link_poses, finger_posture, device_matrix):
    """Gaps on the URDF's solids; each set has a pose of its own."""
    context = shard_context(adjusting, inputs, 0)
    arrays = run_stages(adjusting, context, 0, 1500, "adjust").arrays()
    assert len(np.unique(arrays["candidates.poses.pose"][arrays["pose"]], axis=0)) == len(arrays["pose"]) > 20
    params, hand, obj = adjusting.params("adjust"), inputs.hand.model, inputs.object.model
    row, group = np.nonzero(arrays["chosen"] >= 0)
    own = arrays["pose"][row]
    T = device_matrix(arrays["candidates.poses.pose"])[own]
    surface = arrays["candidates.surface"][own, group, 0]
    target = np.einsum("nij,nj->ni", T[:, :3, :3], obj.contact_points[surface]) + T[:, :3, 3]
    X = link_poses(finger_posture(group, arrays["candidates.q"][own, group, 0]))
    link = hand.contact_link[inputs.field.model.point[arrays["candidates.record"][own, group, 0]]]
    for k in np.unique(link):
        rows = np.flatnonzero(link == k)
        B = X[rows, k]
        p = np.einsum("nji,nj->ni", B[:, :3, :3], target[rows] - B[:, :3, 3])
        assert np.abs(link_distance(int(k), p) + params.contact_indentation).max() < params.gap + 1e-4


def test_batches_change_nothing(adjusting, inputs):
    context = shard_context(adjusting, inputs, 0)
    whole = run_stages(adjusting, context, 0, 600, "filter")
    parts = [run_stages(adjusting, context, *cut, "filter") for cut in ((0, 150), (150, 450))]
    for name in ("index", "slot", "pose", "q"):
        np.testing.assert_array_equal(np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name))
    assert len(whole) > 5


def test_kernel_of_larger_groups_gives_the_same(adjusting, inputs, monkeypatch):
    context = shard_context(adjusting, inputs, 0)

    def poses():
        return run_stages(adjusting, context, 0, 100, "adjust").arrays()["candidates.poses.pose"]

    small = poses()
    monkeypatch.setattr(stage, "step_sets", dict.fromkeys(DOF_SIZES, stage.step_sets[MAX_DOFS]))
    large = poses()
    assert (np.abs(large - small).max(1) < 1e-4).mean() > 0.95  # rounding grows where a set is far


@pytest.mark.parametrize(("hand", "left_out"), [("allegro", "adjust"), ("barrett", "ik"), ("schunk_svh", "ik")])
def test_the_stage_that_suits_a_hand(hand, left_out):
    robust = load_pipeline("robust")
    suited = for_hand(robust, hand).order
    assert suited == tuple(name for name in robust.order if name != left_out)
    # an object on a table stays there
    assert "adjust" not in for_hand(robust.with_table(), hand).order
    assert "adjust" in for_hand(robust.with_params("adjust", joints=8), hand).order


def test_an_object_that_has_to_stay_is_not_adjusted():
    moved = load_pipeline("robust").without("ik")
    for change in (moved.with_table, lambda: moved.with_steering(approach="0,0,1:30")):
        with pytest.raises(ConfigError, match="stage adjust moves the object"):
            change()
