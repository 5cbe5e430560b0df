"""Convex distances against coal, a library-free QP and closed forms."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from support.convex import hull_distance, segment_distance

from lgrasp.hand.piece import Piece
from lgrasp.math.convex import Pieces, pieces_clear, point_depth
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

KINDS = ("hull", "box", "ball", "capsule", "round box")


@wp.kernel
def _clear(
    pieces: Pieces,
    pair: wp.array(dtype=wp.vec2i),
    T: wp.array(dtype=wp.transform),
    margin: wp.array(dtype=wp.float32),
    clear_out: wp.array(dtype=wp.int32),
):
    k = wp.tid()
    clear_out[k] = wp.where(pieces_clear(pieces, pair[k][0], pair[k][1], T[k], margin[k]), 1, 0)


@wp.kernel
def _depth(
    pieces: Pieces, piece: wp.array(dtype=wp.int32), p: wp.array(dtype=wp.vec3), depth_out: wp.array(dtype=float)
):
    k = wp.tid()
    depth_out[k] = point_depth(pieces, piece[k], p[k])


def planes(points: np.ndarray) -> np.ndarray:
    equations = np.unique(np.round(ConvexHull(points).equations, 9), axis=0)
    return np.column_stack([equations[:, :3], -equations[:, 3]])


def random_piece(kind: str, rng: np.random.Generator) -> Piece:
    """A solid of 5 to 40 mm."""
    if kind == "ball":
        return Piece(rng.uniform(-0.01, 0.01, (1, 3)), np.zeros((0, 4)), float(rng.uniform(0.005, 0.02)))
    if kind == "capsule":
        return Piece(rng.uniform(-0.02, 0.02, (2, 3)), np.zeros((0, 4)), float(rng.uniform(0.004, 0.01)))
    if kind == "hull":
        points = rng.normal(size=(int(rng.integers(6, 40)), 3)) * rng.uniform(0.004, 0.015, 3)
        points = points[ConvexHull(points).vertices]
    else:
        corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        points = corner * rng.uniform(0.003, 0.02, 3)
    return Piece(points, planes(points), 2e-4 if kind == "round box" else 0.0)


def upload(pieces: list[Piece], device: str) -> Pieces:
    out = Pieces()

    def first(counts: list[int]) -> wp.array:
        return wp.array(np.concatenate([[0], np.cumsum(counts)]), dtype=wp.int32, device=device)

    out.vertex_first = first([len(p.vertices) for p in pieces])
    out.vertices = wp.array(np.vstack([p.vertices for p in pieces]).astype(np.float32), dtype=wp.vec3, device=device)
    out.plane_first = first([len(p.planes) for p in pieces])
    out.planes = wp.array(np.vstack([p.planes for p in pieces]).astype(np.float32), dtype=wp.vec4, device=device)
    out.sphere = wp.array(np.array([p.sphere for p in pieces], np.float32), dtype=wp.vec4, device=device)
    out.radius = wp.array([p.radius for p in pieces], dtype=wp.float32, device=device)
    return out


def coal_solid(piece: Piece):
    """coal's own shape and its pose in the body frame."""
    coal = pytest.importorskip("coal")
    v = piece.vertices
    if len(v) == 1:
        return coal.Sphere(piece.radius), v[0], np.eye(3)
    if len(v) == 2:
        axis = v[1] - v[0]
        R = Rotation.align_vectors(axis[None] / np.linalg.norm(axis), np.array([[0.0, 0, 1]]))[0].as_matrix()
        return coal.Capsule(piece.radius, float(np.linalg.norm(axis))), v.mean(0), R
    points = coal.StdVec_Vec3s()
    for p in v:
        points.append(p)
    return coal.Convex.convexHull(points, True, "Qt"), np.zeros(3), np.eye(3)


def coal_distance(a: Piece, b: Piece, R: np.ndarray, t: np.ndarray, solids: tuple | None = None) -> float:
    """Signed distance [m] of a to b, b placed by (R, t); negative when deep. ``solids``: both as coal's, if known."""
    coal = pytest.importorskip("coal")
    (sa, pa, Ra), (sb, pb, Rb) = solids or (coal_solid(a), coal_solid(b))
    request = coal.DistanceRequest()
    request.gjk_tolerance = 1e-9
    request.epa_tolerance = 1e-9
    result = coal.DistanceResult()
    d = coal.distance(sa, coal.Transform3s(Ra, pa), sb, coal.Transform3s(R @ Rb, R @ pb + t), request, result)
    inflated = (a.radius if len(a.planes) else 0.0) + (b.radius if len(b.planes) else 0.0)
    return d - inflated


@pytest.fixture(scope="module")
def cases():
    """Pairs near contact: distance from the margin is drawn log-uniformly around 0.2 mm, on both sides."""
    rng = np.random.default_rng(0)
    pieces, pairs, poses, exact, margins = [], [], [], [], []
    for k in range(250):
        a, b = random_piece(KINDS[k % 5], rng), random_piece(KINDS[rng.integers(5)], rng)
        R = Rotation.random(random_state=k).as_matrix()
        u = rng.normal(size=3)
        u /= np.linalg.norm(u)
        margin = float(rng.choice([0.0, 5e-4, 2e-3, 1e-2]))
        away = float(rng.choice([-1, 1]) * 10 ** rng.uniform(-6, -2.3))
        # slide b along u until its distance is margin + away
        low, high, solids = 0.0, 0.2, (coal_solid(a), coal_solid(b))
        for _ in range(24):
            t = 0.5 * (low + high)
            near = coal_distance(a, b, R, t * u, solids) < margin + max(away, 1e-6 - margin)
            low, high = (t, high) if near else (low, t)
        place = 0.5 * (low + high) * u
        pieces += [a, b]
        pairs.append((2 * k, 2 * k + 1))
        poses.append(np.concatenate([place, Rotation.from_matrix(R).as_quat()]))
        exact.append(coal_distance(a, b, R, place))
        margins.append(margin)
    return pieces, np.array(pairs), np.array(poses), np.array(exact), np.array(margins)


def ask(device, pieces, pairs, poses, margins) -> np.ndarray:
    out = wp.zeros(len(pairs), dtype=wp.int32, device=device)
    inputs = [
        upload(pieces, device),
        wp.array(pairs.astype(np.int32), dtype=wp.vec2i, device=device),
        wp.array(poses.astype(np.float32), dtype=wp.transform, device=device),
        wp.array(margins.astype(np.float32), dtype=wp.float32, device=device),
    ]
    wp.launch(_clear, len(pairs), inputs, [out], device=device)
    return out.numpy().astype(bool)


def test_clear_agrees_with_coal(device, cases):
    pieces, pairs, poses, exact, margins = cases
    clear = ask(device, pieces, pairs, poses, margins)
    assert (exact < margins).sum() > 50
    assert (np.abs(exact - margins) < 2e-4).sum() > 80
    false_clear = clear & (exact < margins - 1e-5)
    assert not false_clear.any(), (exact - margins)[false_clear]
    missed = ~clear & (exact > margins + 1e-4)
    far = exact > margins + 1e-5
    print(f"clear pairs called not clear: {missed.sum()} beyond 0.1 mm; {(~clear & far).mean():.2%} beyond 0.01 mm")
    assert not missed.any(), (exact - margins)[missed]


def test_clear_agrees_the_other_way_round(device, cases):
    pieces, pairs, poses, exact, margins = cases
    R = Rotation.from_quat(poses[:, 3:]).inv()
    back = np.hstack([-R.apply(poses[:, :3]), R.as_quat()])
    clear = ask(device, pieces, pairs[:, ::-1], back, margins)
    assert not (clear & (exact < margins - 1e-5)).any()
    assert not (~clear & (exact > margins + 1e-4)).any()


def test_coal_itself_agrees_with_the_quadratic_problem():
    rng = np.random.default_rng(1)
    for k in range(25):
        a, b = random_piece("hull", rng), random_piece("box", rng)
        R, t = Rotation.random(random_state=k).as_matrix(), rng.uniform(-0.04, 0.04, 3)
        plain = hull_distance(a.vertices, b.vertices @ R.T + t)
        assert max(coal_distance(a, b, R, t), 0.0) == pytest.approx(plain, abs=1e-6)


def test_deep_overlap_and_same_place_are_not_clear(device):
    rng = np.random.default_rng(2)
    pieces = [random_piece(kind, rng) for kind in KINDS for _ in range(20)]
    n = len(pieces)
    pairs = np.column_stack([np.arange(n), np.arange(n)])
    still = np.tile([0.0, 0, 0, 0, 0, 0, 1], (n, 1))
    assert not ask(device, pieces, pairs, still, np.zeros(n)).any()
    # touching faces: two boxes side by side, and a hair apart
    box = random_piece("box", rng)
    width = 2 * box.vertices[:, 0].max()
    for gap, expected in ((-1e-4, False), (1e-4, True), (1e-2, True)):
        beside = np.array([[width + gap, 0, 0, 0, 0, 0, 1]])
        assert ask(device, [box, box], np.array([[0, 1]]), beside, np.zeros(1))[0] == expected


def test_long_thin_pieces(device):
    """Needles and plates: the shapes on which simplex methods lose their footing."""
    rng = np.random.default_rng(3)
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    sizes = [(0.05, 3e-4, 3e-4), (0.05, 0.05, 2e-4), (0.03, 1e-3, 1e-2)]
    pieces, poses, exact = [], [], []
    for k in range(300):
        a, b = (corner * sizes[rng.integers(3)] for _ in range(2))
        R, t = Rotation.random(random_state=k), rng.uniform(-0.05, 0.05, 3)
        pieces += [Piece(a, planes(a), 0.0), Piece(b, planes(b), 0.0)]
        poses.append(np.concatenate([t, R.as_quat()]))
        exact.append(coal_distance(pieces[-2], pieces[-1], R.as_matrix(), t))
    exact = np.array(exact)
    pairs = np.arange(600).reshape(-1, 2)
    for margin in (0.0, 1e-3):
        clear = ask(device, pieces, pairs, np.array(poses), np.full(300, margin))
        assert not (clear & (exact < margin - 1e-5)).any()
        assert not (~clear & (exact > margin + 1e-4)).any()


def depths(device, pieces: list[Piece], piece: np.ndarray, p: np.ndarray) -> np.ndarray:
    out = wp.empty(len(p), dtype=wp.float32, device=device)
    inputs = [
        upload(pieces, device),
        wp.array(piece.astype(np.int32), dtype=wp.int32, device=device),
        wp.array(p.astype(np.float32), dtype=wp.vec3, device=device),
    ]
    wp.launch(_depth, len(p), inputs, [out], device=device)
    return out.numpy()


def test_point_depth_of_balls_and_capsules(device):
    rng = np.random.default_rng(4)
    pieces = [random_piece(kind, rng) for kind in ("ball", "capsule") for _ in range(10)]
    p = rng.uniform(-0.025, 0.025, (4000, 3))
    piece = rng.integers(len(pieces), size=len(p))
    found = depths(device, pieces, piece, p)
    solids = [pieces[i] for i in piece]
    exact = np.array(
        [segment_distance(x[None], s.vertices[0], s.vertices[-1])[0] - s.radius for x, s in zip(p, solids, strict=True)]
    )
    inside = exact < 0
    assert inside.sum() > 50
    np.testing.assert_allclose(found[inside], exact[inside], atol=1e-7)
    assert (found <= exact + 1e-7).all()
    assert (found[~inside] >= -1e-7).all()


def test_point_depth_of_boxes_and_hulls(device):
    rng = np.random.default_rng(5)
    pieces = [random_piece(kind, rng) for kind in ("hull", "box", "round box") for _ in range(6)]
    p = rng.uniform(-0.03, 0.03, (3000, 3))
    piece = rng.integers(len(pieces), size=len(p))
    found = depths(device, pieces, piece, p)
    exact = np.array([pieces[i].depth(x[None])[0] for i, x in zip(piece, p, strict=True)])
    inside = exact < 0
    assert inside.sum() > 50
    np.testing.assert_allclose(found[inside], exact[inside], atol=1e-7)
    for i, x, d in zip(piece[:300], p[:300], found[:300], strict=True):
        true = hull_distance(x[None], pieces[i].vertices) - pieces[i].radius
        assert d <= true + 1e-6
        assert (d < 1e-7) == (exact[np.flatnonzero((p == x).all(1))[0]] < 1e-7)


def test_depth_of_a_box_closed_form(device):
    half = np.array([0.01, 0.02, 0.03])
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    p = np.random.default_rng(6).uniform(-1.2, 1.2, (2000, 3)) * half
    found = depths(device, [Piece(corner, planes(corner), 0.0)], np.zeros(len(p)), p)
    exact = (np.abs(p) - half).max(1)
    inside = exact < 0
    np.testing.assert_allclose(found[inside], exact[inside], atol=1e-7)
    assert (found[~inside] >= 0).all()
