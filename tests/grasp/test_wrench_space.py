"""Epsilon and volume of the wrench hull, and the kernel's bound: closed forms, linear programs, invariances."""

from itertools import product

import numpy as np
import pytest
import warp as wp
from scipy.optimize import linprog
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from lgrasp.grasp.wrench_space import WrenchSpace, primitive_wrenches, wrench_space, wrench_spaces
from lgrasp.math.limits import MAX_CONTACTS
from lgrasp.math.quality import epsilon_bound
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

AXES = np.vstack([np.eye(3), -np.eye(3)])
NONE = WrenchSpace(0.0, 0.0)


@wp.kernel
def _bound(
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    mu: wp.float32,
    radius: wp.float32,
    bound_out: wp.array(dtype=wp.float32),
):
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    for c in range(point.shape[0]):
        points[c] = point[c]
        normals[c] = normal[c]
    bound_out[0] = epsilon_bound(points, normals, point.shape[0], mu, radius, wp.rand_init(5))


def bound(points, normals, radius, friction=0.5) -> float:
    """The kernel's bound of epsilon, torques about the origin."""
    out = wp.empty(1, dtype=wp.float32, device="cpu")
    arrays = [wp.array(a.astype(np.float32), dtype=wp.vec3, device="cpu") for a in (points, normals)]
    wp.launch(_bound, 1, [*arrays, friction, radius], [out], device="cpu")
    return float(out.numpy()[0])


def exact(points, normals, radius, friction=0.5, edges=8) -> WrenchSpace:
    return wrench_space(wrenches(points, normals, radius, friction, edges))


def wrenches(points, normals, radius, friction=0.5, edges=8) -> np.ndarray:
    return primitive_wrenches(points, normals, center=np.zeros(3), radius=radius, friction=friction, edges=edges)


def contacts(k: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Contacts on a ball of 5 cm, normals roughly inward."""
    random = np.random.default_rng(seed)
    out = random.normal(size=(k, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    normals = -out + 0.25 * random.normal(size=(k, 3))
    return 0.05 * out, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def paired_box(a: float, b: float) -> tuple[np.ndarray, np.ndarray]:
    """Two contacts on each face of a cube of half side a, b beside its middle: along y on +-x, z on +-y, x on +-z."""
    sides = [(i, s, t) for i in range(3) for s in (1, -1) for t in (1, -1)]
    points = [s * a * np.eye(3)[i] + t * b * np.eye(3)[(i + 1) % 3] for i, s, t in sides]
    return np.array(points), np.array([-s * np.eye(3)[i] for i, s, _ in sides])


@pytest.mark.parametrize("radius", [0.01, 0.02, 0.07])
def test_frictionless_box(radius):
    """Epsilon min(1, B) / sqrt 3 and volume 32 B^3 / 45, B = b / radius.

    The contacts at (+-a, t b, 0), t = +-1, give the force -+e_x and the torque (+-a, t b, 0) x (-+1, 0, 0) = +-t b e_z:
    the four corners (+-1, +-B) of a rectangle in the plane of fx and tz. The other faces give rectangles in (fy, tx)
    and (fz, ty). These planes are orthogonal and each rectangle holds the origin, so the hull is their direct sum. Its
    polar body is the product of the polar bodies, rhombi with corners (+-1, 0), (0, +-1/B), whose farthest point is
    sqrt 3 max(1, 1/B) away; epsilon is the inverse. The volume of a direct sum is (2! 2! 2! / 6!) times the product of
    the areas, 4 B each.
    """
    ratio = 0.02 / radius
    got = exact(*paired_box(0.03, 0.02), radius, friction=0)
    assert got.epsilon == pytest.approx(min(1, ratio) / np.sqrt(3), abs=1e-8)
    assert got.volume == pytest.approx(32 * ratio**3 / 45, rel=1e-8)


@pytest.mark.parametrize("ratio", [0.02, 0.1, 0.3, 0.6])
def test_six_contacts_with_friction(ratio):
    """Contacts on the axes of a ball, arm r: epsilon mu L sqrt(2/3), L = r / radius, for L small.

    For a direction (p, t) put T = L t and let K(v) = max(|v1|, |v2|, (|v1| + |v2|) / sqrt 2), the support function of
    the octagon that the cone's edges form. The contact at +-e_i has the support -+p_i + mu K(p' +- J T'), where '
    leaves out component i and J turns by 90 degrees. The mean of the two is at least mu K(J T') (K is even and convex),
    so the polar body {support <= 1} holds (0, T) with every (p, T), and in it |T_j|, |T_k|, (|T_j| + |T_k|) / sqrt 2
    <= 1 / mu for each pair. The largest |T|^2 under these bounds is 3 / (2 mu^2), at T* = (1, 1, 1) / (sqrt 2 mu) and
    its mirror images; the other corners, (1, sqrt 2 - 1, sqrt 2 - 1) / mu, are nearer. At T* all six supports are 1 and
    only the diagonals of the octagons count, so p != 0 would need p_i = mu (+-p_j +- p_k) / sqrt 2 for every i, which
    has no solution as mu sqrt 2 < 1. In the coordinates (p, T) the polar body does not depend on L, and its size is
    |p|^2 + |T|^2 / L^2: for small L the corner (0, T*) is its farthest point, and epsilon = L / |T*|.
    """
    want = 0.5 * ratio * np.sqrt(2 / 3)
    assert exact(AXES, -AXES, 1 / ratio).epsilon == pytest.approx(want, abs=1e-8)
    assert want - 1e-6 <= bound(AXES, -AXES, 1 / ratio) <= 1.02 * want


@pytest.mark.parametrize("ratio", [0.02, 0.1, 0.3, 0.6])
def test_four_contacts_with_friction(ratio):
    """Contacts on two axes: epsilon mu L / sqrt(5 - 2 sqrt 2), L = r / radius, for L small.

    As above without the contacts on z: the bounds left are those of the pairs (T_y, T_z) and (T_x, T_z). The largest
    |T|^2 is then (1 + 1 + (sqrt 2 - 1)^2) / mu^2 = (5 - 2 sqrt 2) / mu^2, at T* = (1, 1, sqrt 2 - 1) / mu, where two
    corners of each octagon count together; that leaves p = 0 only.
    """
    points = AXES[[0, 1, 3, 4]]
    want = 0.5 * ratio / np.sqrt(5 - 2 * np.sqrt(2))
    assert exact(points, -points, 1 / ratio).epsilon == pytest.approx(want, abs=1e-8)
    assert want - 1e-6 <= bound(points, -points, 1 / ratio) <= 1.02 * want


@pytest.mark.parametrize("seed", range(4))
def test_seven_frictionless_contacts(seed):
    """Seven wrenches span a simplex: facets and volume by linear algebra, for the hull and for the kernel.

    The facet opposite wrench i lies in the plane y . w = 1, y the solution of its six equations: 1 / |y| away from the
    origin. The volume is |det| / 6!. Contacts are drawn until the origin lies inside.
    """
    random = np.random.default_rng(seed)
    while True:
        points, normals = random.uniform(-1, 1, (7, 3)), random.normal(size=(7, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        W = wrenches(points, normals, 1.0, friction=0)
        weights = np.linalg.solve(np.vstack([W.T, np.ones(7)]), np.append(np.zeros(6), 1.0))
        if weights.min() > 0.02:
            break
    y = [np.linalg.solve(np.delete(W, i, 0), np.ones(6)) for i in range(7)]
    epsilon = 1 / max(map(np.linalg.norm, y))
    got = exact(points, normals, 1.0, friction=0)
    assert got.epsilon == pytest.approx(epsilon, rel=1e-7)
    assert got.volume == pytest.approx(abs(np.linalg.det(W[1:] - W[0])) / 720, rel=1e-7)
    assert epsilon * (1 - 1e-4) <= bound(points, normals, 1.0, friction=0) <= 1.02 * epsilon


def reach(W: np.ndarray, way: np.ndarray) -> float:
    """How far the hull of W reaches along a direction: max s with s way a convex combination of the wrenches."""
    A = np.vstack([np.column_stack([W.T, -way]), np.append(np.ones(len(W)), 0.0)])
    cost = np.append(np.zeros(len(W)), -1.0)
    answer = linprog(cost, A_eq=A, b_eq=np.append(np.zeros(6), 1.0), bounds=[(0, None)] * len(W) + [(None, None)])
    return -answer.fun if answer.status == 0 else -np.inf


def epsilon_by_programs(W: np.ndarray, starts: int, random: np.random.Generator) -> float:
    """1 / largest |y| with w . y <= 1 for every wrench, climbed by linear programs from many starts; 0 if unbounded."""
    longest = 0.0
    for way in random.normal(size=(starts, 6)):
        y, length = way, 0.0
        while True:
            answer = linprog(-y, A_ub=W, b_ub=np.ones(len(W)), bounds=(None, None))
            if answer.status == 3:
                return 0.0
            y = answer.x
            if np.linalg.norm(y) <= length * (1 + 1e-9):
                break
            length = float(np.linalg.norm(y))
        longest = max(longest, length)
    return 1 / longest


@pytest.mark.parametrize(("k", "seed", "closed"), [(3, 1, False), (3, 10, True), (4, 0, True)])
def test_against_linear_programs(k, seed, closed):
    random = np.random.default_rng(seed)
    points, normals = contacts(k, seed)
    W = wrenches(points, normals, 0.05)
    got = wrench_space(W)
    by_programs = epsilon_by_programs(W, 25, random)
    assert (got.epsilon > 0) == closed
    assert got.epsilon == pytest.approx(by_programs, rel=1e-6, abs=1e-8)
    assert bound(points, normals, 0.05) >= by_programs - 1e-6
    if closed:
        hull = ConvexHull(W)
        nearest = hull.equations[hull.equations[:, 6].argmax(), :6]
        assert reach(W, nearest) == pytest.approx(got.epsilon, rel=1e-6)
        assert min(reach(W, way / np.linalg.norm(way)) for way in random.normal(size=(20, 6))) >= got.epsilon - 1e-9


def test_scaling():
    points, normals = contacts(4, 0)
    got = exact(points, normals, 0.05)
    assert exact(3 * points, normals, 3 * 0.05) == pytest.approx(got, rel=1e-6)  # a larger object
    assert exact(points, normals, 2 * 0.05).volume == pytest.approx(got.volume / 2**3, rel=1e-6)
    double = wrench_space(2 * wrenches(points, normals, 0.05))  # twice the force
    assert double == pytest.approx((2 * got.epsilon, 2**6 * got.volume), rel=1e-6)


def test_turning_the_object():
    """Exactly invariant where the cones turn along: without friction, and by turns of a cube."""
    points, normals = paired_box(0.03, 0.02)
    got = exact(points, normals, 0.05, friction=0)
    for R in Rotation.random(3, random_state=0).as_matrix():
        assert exact(points @ R.T, normals @ R.T, 0.05, friction=0) == pytest.approx(got, rel=1e-6)
    points, normals = contacts(4, 0)
    got = exact(points, normals, 0.05)
    for order, signs in product([(1, 2, 0), (0, 2, 1)], product((1, -1), repeat=3)):
        R = np.eye(3)[list(order)] * signs
        if np.linalg.det(R) > 0:
            assert exact(points @ R.T, normals @ R.T, 0.05) == pytest.approx(got, rel=1e-6)
    round_cones = exact(points, normals, 0.05, edges=48)
    R = Rotation.random(random_state=1).as_matrix()
    assert exact(points @ R.T, normals @ R.T, 0.05, edges=48) == pytest.approx(round_cones, rel=0.01)


def test_order_and_number_of_contacts():
    points, normals = contacts(5, 1)
    got = exact(points, normals, 0.05)
    order = [3, 1, 4, 0, 2]
    assert exact(points[order], normals[order], 0.05) == pytest.approx(got, rel=1e-7)
    again = [0, 1, 2, 3, 4, 2]
    assert exact(points[again], normals[again], 0.05) == pytest.approx(got, rel=1e-7)
    fewer = exact(points[:4], normals[:4], 0.05)  # one more contact takes nothing away
    assert fewer.epsilon <= got.epsilon + 1e-9
    assert fewer.volume <= got.volume + 1e-9


def test_open_grasps_have_neither():
    two = np.array([[0.05, 0, 0], [-0.05, 0, 0]])
    assert exact(two, -two / 0.05, 0.05) == NONE  # nothing resists a torque about the line between them
    assert exact(two[:1], -two[:1] / 0.05, 0.05) == NONE
    assert wrench_space(np.zeros((0, 6))) == NONE
    ball, _ = contacts(7, 0)
    assert exact(ball, -ball / 0.05, 0.05, friction=0) == NONE  # no torque about the middle of a ball
    points, normals = contacts(4, 0)
    pulled = normals - [0, 0, 5.0]  # all push down
    assert exact(points, pulled / np.linalg.norm(pulled, axis=1, keepdims=True), 0.05, friction=0.2) == NONE


def test_padding_and_frame():
    (points, normals), center = contacts(3, 3), np.array([0.3, -0.2, 0.1])
    padded_points, padded_normals = np.full((2, 4, 3), np.nan), np.full((2, 4, 3), np.nan)
    padded_points[0, [0, 2, 3]], padded_normals[0, [0, 2, 3]] = points + center, normals
    got = wrench_spaces(padded_points.astype("f4"), padded_normals.astype("f4"), center, 0.05, 0.5)
    assert got[0] == pytest.approx(exact(points, normals, 0.05), rel=1e-4)
    assert got[1].tolist() == [0, 0]
