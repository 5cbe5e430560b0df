"""Sums of depths against every point looked up by itself, against balls, and derivatives against differences."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.hands import hand_model

from lgrasp.differentiable.distance import DistanceGrids
from lgrasp.differentiable.kinematics import BodyKinematics
from lgrasp.differentiable.solids import RUN, HandPoints, PointSolid, hand_solids, object_solid
from lgrasp.object.find import find_object
from lgrasp.object.params import ObjectParams
from lgrasp.object.preprocess import preprocess_object
from lgrasp.object.sdf import SdfGrid
from lgrasp.sequence.optimiser.culling import Culling
from lgrasp.sequence.optimiser.penetration import PenetrationSums


def ball(radius: float, points: int, cell: float = 0.001) -> PointSolid:
    """A ball about the origin."""
    nodes = int(np.ceil(radius / cell)) + 3
    at = cell * (np.indices((2 * nodes + 1,) * 3) - nodes)
    grid = SdfGrid(
        (np.linalg.norm(at, axis=0) - radius).astype(np.float32), np.full(3, -nodes * cell, np.float32), cell
    )
    turn, z = np.pi * (1 + 5**0.5) * np.arange(points), 1 - 2 * (np.arange(points) + 0.5) / points
    d = np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])
    p = (radius * d).astype(np.float32)
    whole = np.array([0, 0, 0, radius], np.float32)
    return PointSolid(p, np.tile(whole, (points // RUN, 1)), whole, grid)


@pytest.fixture(scope="module")
def hand() -> HandPoints:
    return hand_solids(hand_model("shipped"), 1024)


@pytest.fixture(scope="module")
def mug() -> PointSolid:
    params = ObjectParams(sdf_cells=32**3, obstacle_count=1024, contact_count=256)
    return object_solid(preprocess_object(find_object("mug"), params=params), 512)


@pytest.fixture(scope="module")
def scene(hand, mug) -> tuple[list[PointSolid], np.ndarray, np.ndarray, np.ndarray]:
    """The hand and a mug: solids, frames, pairs, terms (hand in mug, mug in hand, hand in itself)."""
    links = len(hand.solids)
    frame = np.append(hand.body, 17)
    pairs = np.concatenate([np.column_stack([np.arange(links), np.full(links, links)]), hand.pairs])
    terms = np.concatenate([np.tile([0, 1], (links, 1)), np.full(hand.pairs.shape, 2)])
    return [*hand.solids, mug], frame, pairs, terms


def poses(n: int, seed: int, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    """Frames of random postures of the hand and of an object in its grip."""
    rng = np.random.default_rng(seed)
    tree = hand_model("shipped").tree
    q = torch.from_numpy(rng.uniform(tree.joint_lower, tree.joint_upper, (n, 16)))
    R, t = BodyKinematics(tree, dtype=torch.float64)(q)
    R_object = torch.from_numpy(Rotation.random(n, random_state=seed).as_matrix())[:, None]
    t_object = torch.from_numpy(rng.uniform([0.0, -0.05, -0.05], [0.08, 0.05, 0.1], (n, 3)))[:, None]
    return torch.cat([R, R_object], 1).to(dtype), torch.cat([t, t_object], 1).to(dtype)


def every_point(scene, R: torch.Tensor, t: torch.Tensor) -> np.ndarray:
    """The same sums, one point after another."""
    solids, frame, pairs, terms = scene
    grids = DistanceGrids([s.grid for s in solids], dtype=torch.float64)
    out = np.zeros((len(R), 3))
    for row in range(len(R)):
        for (a, b), (term_a, term_b) in zip(pairs, terms, strict=True):
            for x, y, term in ((a, b, term_a), (b, a, term_b)):
                p = torch.from_numpy(solids[x].points.astype(float))
                p = p @ R[row, frame[x]].T + t[row, frame[x]] - t[row, frame[y]]
                out[row, term] += (-grids.value(p @ R[row, frame[y]], int(y))).clamp_min(0).sum().item()
    return out


def test_nothing_is_left_out(scene):
    R, t = poses(5, 5)
    found = PenetrationSums(*scene, 3, dtype=torch.float64)(R, t).numpy()
    expected = every_point(scene, R, t)
    assert (expected > 0.01).any(0).all()
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_two_balls():
    """The cap that is inside another ball, integrated."""
    r, gap = 0.02, 0.03
    solids = [ball(r, 8192), ball(r, 8192)]
    sums = PenetrationSums(solids, [0, 1], np.array([[0, 1]]), np.array([[0, 1]]), 2, dtype=torch.float64)
    R = torch.eye(3, dtype=torch.float64).expand(1, 2, 3, 3)
    t = torch.tensor([[[0.0, 0, 0], [0, gap, 0]]], dtype=torch.float64)
    c = np.linspace(gap / 2 / r, 1, 20_001)  # cosine from the axis; the surface is uniform in it
    depth = r - np.sqrt(r**2 + gap**2 - 2 * r * gap * c)
    expected = 0.5 * np.trapezoid(np.maximum(depth, 0), c)
    np.testing.assert_allclose(sums(R, t).numpy() / 8192, [[expected] * 2], rtol=0.01)


@pytest.mark.parametrize("seed", [1])
def test_derivatives_equal_finite_differences(scene, seed):
    sums = PenetrationSums(*scene, 3, dtype=torch.float64)
    R, t = poses(2, seed)
    rng = np.random.default_rng(seed)
    weight = torch.tensor([1.0, 1.0, 1.0], dtype=torch.float64)
    for _ in range(8):
        dR, dt = torch.from_numpy(rng.normal(size=R.shape)), torch.from_numpy(0.05 * rng.normal(size=t.shape))

        def along(s: torch.Tensor, dR=dR, dt=dt) -> torch.Tensor:
            return (sums(R + s * dR, t + s * dt) * weight).sum()

        s, h = torch.zeros((), dtype=torch.float64, requires_grad=True), 1e-9
        (slope,) = torch.autograd.grad(along(s), s)
        difference = (along(torch.tensor(h, dtype=torch.float64)) - along(torch.tensor(-h, dtype=torch.float64))) / (
            2 * h
        )
        assert slope.item() == pytest.approx(difference.item(), rel=1e-3)


def test_rows_do_not_depend_on_their_neighbours(scene):
    sums = PenetrationSums(*scene, 3)
    R, t = poses(12, 3, torch.float32)
    together, slopes = sums.slopes(R, t)
    for row in range(12):
        alone, own = sums.slopes(R[row : row + 1], t[row : row + 1])
        assert torch.equal(alone[0], together[row])
        assert torch.equal(own[0], slopes[row])


def test_fixed_room_gives_the_same_and_tells_when_it_lacks(scene):
    """Shapes that do not depend on the data: bit by bit the same; too little room is told and made good."""
    sums = PenetrationSums(*scene, 3)
    R, t = poses(10, 3, torch.float32)
    expected = sums.slopes(R, t)
    sums.culling = Culling((40, 2, 100, 20, 2, 1), "cpu")
    sums.culling.fix(10)
    rounds = 1
    found = sums.slopes(R, t)
    assert sums.culling.lacking(10)
    while True:
        found = sums.slopes(R, t)
        if not sums.culling.lacking(10):
            break
        rounds += 1
    assert rounds <= 6  # at most one for each stage
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
    sums.culling.free()
    assert all(torch.equal(a, b) for a, b in zip(sums.slopes(R, t), expected, strict=True))


def test_solids_that_are_apart_add_nothing(scene):
    R, t = poses(3, 4)
    t[:, -1] += 1.0
    sums, slopes = PenetrationSums(*scene, 3, dtype=torch.float64).slopes(R, t)
    assert not sums[:, :2].any()
    assert not slopes[:, :2].any()


def test_points_of_a_hand_are_on_its_surface(hand):
    model = hand_model("shipped")
    assert {int(k) for k in hand.links} == set(model.piece_link.tolist())
    assert abs(sum(len(s.points) for s in hand.solids) - 1024) < 21 * RUN
    for solid in hand.solids:
        value = DistanceGrids([solid.grid]).value(torch.from_numpy(solid.points))
        assert value.abs().max() < 1e-3 + 0.5 * solid.grid.cell
        assert (np.linalg.norm(solid.points - solid.ball[:3], axis=1) < solid.ball[3] + 1e-4).all()
