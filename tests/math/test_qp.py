"""Wrench residuals against exact problems: equations, cones, invariances and degenerate contacts."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.wrench import cone_forces, is_balanced, residual, unresisted

from lgrasp.math import loads
from lgrasp.math.frictionless import frictionless
from lgrasp.math.limits import MAX_CONTACTS
from lgrasp.math.qp import NO_LIMIT, balance, balances
from lgrasp.math.transforms import vec3s
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

SCALE = 10.0


@wp.func
def take(
    arm: wp.array2d(dtype=wp.vec3),
    normal: wp.array2d(dtype=wp.vec3),
    i: wp.int32,
    k: wp.int32,
    arms: vec3s,
    normals: vec3s,
):
    """The first k contacts of problem i, in local arrays."""
    for c in range(k):
        arms[c] = arm[i, c]
        normals[c] = normal[i, c]


@wp.kernel
def _balance(
    arm: wp.array2d(dtype=wp.vec3),
    normal: wp.array2d(dtype=wp.vec3),
    count: wp.array(dtype=wp.int32),
    mu: wp.float32,
    edges: wp.int32,
    scale: wp.float32,
    stop: wp.float32,
    norm_out: wp.array(dtype=wp.float32),
    force_out: wp.array2d(dtype=wp.vec3),
):
    i = wp.tid()
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    k = count[i]
    take(arm, normal, i, k, arms, normals)
    norm_out[i] = balance(arms, normals, k, mu, edges, scale, stop, NO_LIMIT, 0.0, forces)
    for c in range(k):
        force_out[i, c] = forces[c]


@wp.kernel
def _frictionless(
    arm: wp.array2d(dtype=wp.vec3),
    normal: wp.array2d(dtype=wp.vec3),
    k: wp.int32,
    scale: wp.float32,
    score_out: wp.array(dtype=wp.vec2),
):
    i = wp.tid()
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    take(arm, normal, i, k, arms, normals)
    score_out[i] = frictionless(arms, normals, k, scale)


def solve(device, arms, normals, count=None, *, mu=0.0, edges=0, stop=0.0) -> tuple[np.ndarray, np.ndarray]:
    """Norms (n,) and forces (n, MAX_CONTACTS, 3) of n problems with arms and normals (n, k, 3)."""
    n, k, _ = arms.shape
    count = np.full(n, k, np.int32) if count is None else count
    pad = ((0, 0), (0, MAX_CONTACTS - k), (0, 0))
    inputs = [
        wp.array(np.pad(arms, pad).astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(np.pad(normals, pad).astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(count, dtype=wp.int32, device=device),
        *(mu, edges, SCALE, stop),
    ]
    norm = wp.empty(n, dtype=wp.float32, device=device)
    force = wp.zeros((n, MAX_CONTACTS), dtype=wp.vec3, device=device)
    wp.launch(_balance, n, inputs, [norm, force], device=device)
    return norm.numpy(), force.numpy()


@wp.kernel
def _disturbance(
    arm: wp.array2d(dtype=wp.vec3),
    normal: wp.array2d(dtype=wp.vec3),
    turn: wp.array(dtype=wp.quat),
    mu: wp.float32,
    limit: wp.float32,
    worst_out: wp.array(dtype=wp.float32),
):
    """The worst of six directions, those first that contacts lack most; some value above the limit if it is above."""
    i = wp.tid()
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    take(arm, normal, i, arm.shape[1], arms, normals)
    k = arm.shape[1]
    worst = float(0.0)
    for rank in range(6):
        if worst <= limit:
            direction = loads.by_difficulty(normals, k, mu, turn[i], rank)
            worst = wp.max(worst, loads.unresisted(arms, normals, k, mu, turn[i], direction, worst, limit))
    worst_out[i] = worst


def unheld(device, arms, normals, turn, mu=0.5, limit=1.0) -> np.ndarray:
    """Disturbance residuals (n,) of problems with arms and normals (n, k, 3), turned by ``turn`` (n quaternions)."""
    inputs = [wp.array(a.astype(np.float32), dtype=wp.vec3, device=device) for a in (arms, normals)]
    inputs.append(wp.array(turn.as_quat().astype(np.float32), dtype=wp.quat, device=device))
    worst = wp.empty(len(arms), dtype=wp.float32, device=device)
    wp.launch(_disturbance, len(arms), [*inputs, mu, limit], [worst], device=device)
    return worst.numpy()


@wp.kernel
def _decide(
    arm: wp.array2d(dtype=wp.vec3),
    normal: wp.array2d(dtype=wp.vec3),
    mu: wp.float32,
    limit: wp.float32,
    balances_out: wp.array(dtype=wp.bool),
    order_out: wp.array2d(dtype=wp.int32),
):
    """Whether friction balances each problem, and the order of its directions, (n, 6)."""
    i = wp.tid()
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    take(arm, normal, i, arm.shape[1], arms, normals)
    balances_out[i] = balances(arms, normals, arm.shape[1], mu, SCALE, limit)
    for rank in range(6):
        order_out[i, rank] = loads.by_difficulty(normals, arm.shape[1], mu, wp.quat_identity(), rank)


def units(rng: np.random.Generator, *shape: int) -> np.ndarray:
    v = rng.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def problems(n: int, k: int, seed: int, *, inward: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Contacts on a ball of 3 to 10 cm, normals roughly inward: like grasps, feasible or nearly so."""
    rng = np.random.default_rng(seed)
    out = units(rng, n, k)
    arms = out * rng.uniform(0.03, 0.1, (n, 1, 1))
    normals = -inward * out + 0.4 * rng.normal(size=(n, k, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return (arms - arms.mean(1, keepdims=True)).astype(np.float32), normals.astype(np.float32)


def exact_residuals(arms: np.ndarray, normals: np.ndarray, mu: float, edges: int) -> np.ndarray:
    pairs = zip(arms.astype(float), normals.astype(float), strict=True)
    return np.array([residual(a, n, mu, edges, SCALE) for a, n in pairs])


@pytest.mark.parametrize("k", range(2, MAX_CONTACTS + 1))
@pytest.mark.parametrize(("mu", "edges"), [(0.0, 0), (0.5, 8), (0.3, 12)])
def test_norm_is_the_exact_minimum(device, k, mu, edges):
    arms, normals = problems(60, k, k)
    norm, _ = solve(device, arms, normals, mu=mu, edges=edges)
    exact = exact_residuals(arms, normals, mu, edges)
    assert (norm > exact - 2e-5).all()
    # the stopping rule: norm^2 is within 1e-6 + 1e-4 norm^2 of its least value, so near 0 the norm is within 1e-3
    assert (norm**2 < exact**2 + 3e-6 + 4e-4 * exact**2).all()


def test_feasible_exactly_when_the_linear_program_is(device):
    arms, normals = problems(150, 3, 99)
    norm, _ = solve(device, arms, normals, mu=0.5, edges=8)
    feasible = np.array([is_balanced(a, n, 0.5, 8, SCALE) for a, n in zip(arms, normals, strict=True)])
    assert 20 < feasible.sum() < 130
    assert norm[feasible].max() < 2e-3
    assert norm[~feasible].min() > 1e-4


@pytest.mark.parametrize("k", [2, 3, 4, 6])
@pytest.mark.parametrize(("mu", "edges"), [(0.0, 0), (0.5, 8), (0.5, 0)])
def test_forces_lie_in_the_cones_and_make_the_residual(device, k, mu, edges):
    arms, normals = problems(200, k, 10 + k)
    norm, forces = solve(device, arms, normals, mu=mu, edges=edges)
    f = forces[:, :k].astype(float)
    along = (f * normals).sum(-1)
    np.testing.assert_allclose(along.sum(1), 1.0, atol=1e-5)
    assert along.min() > -1e-6
    across = np.linalg.norm(f - along[..., None] * normals, axis=-1)
    assert (across <= mu * along + 1e-5).all()
    if edges:
        # inside the pyramid: each facet's bound
        for a, n, row in zip(along, normals.astype(float), f, strict=True):
            e = cone_forces(n, mu, edges) - n[:, None]  # tangential parts of the edges
            mid = 0.5 * (e + np.roll(e, -1, axis=1))
            bound = (mid * mid).sum(-1)
            assert ((row[:, None] * mid).sum(-1) <= bound * a[:, None] + 1e-5).all()
    w = np.concatenate([f.sum(1), SCALE * np.cross(arms, f).sum(1)], 1)
    np.testing.assert_allclose(np.linalg.norm(w, axis=1), norm, atol=2e-5)


def test_wider_cones_never_leave_more(device):
    arms, normals = problems(300, 3, 5)
    none, _ = solve(device, arms, normals)
    inscribed, _ = solve(device, arms, normals, mu=0.5 * np.cos(np.pi / 8))
    eight, _ = solve(device, arms, normals, mu=0.5, edges=8)
    round_cone, _ = solve(device, arms, normals, mu=0.5)
    wide, _ = solve(device, arms, normals, mu=0.8)
    slack = 1e-3  # of the stopping rule near 0
    for wider, narrower in [(inscribed, none), (eight, inscribed), (round_cone, eight), (wide, round_cone)]:
        assert (wider <= narrower + slack).all()
    assert (wide < none - 0.01).mean() > 0.5


def test_round_cone_is_the_limit_of_many_edges(device):
    arms, normals = problems(40, 3, 6)
    norm, _ = solve(device, arms, normals, mu=0.5)
    limit = exact_residuals(arms, normals, 0.5, 96)
    assert (norm**2 < limit**2 + 1e-5 + 3e-4 * limit**2).all()
    assert (norm > limit * np.cos(np.pi / 96) - 2e-3).all()


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), k=st.integers(2, 5), mu=st.sampled_from([0.0, 0.5]))
def test_rigid_motion_and_order_change_nothing(seed, k, mu):
    rng = np.random.default_rng(seed)
    arms, normals = problems(8, k, seed)
    R = Rotation.random(random_state=seed).as_matrix()
    order = rng.permutation(k)
    here, _ = solve("cpu", arms, normals, mu=mu)
    turned, _ = solve("cpu", arms @ R.T, normals @ R.T, mu=mu)
    shuffled, _ = solve("cpu", arms[:, order], normals[:, order], mu=mu)
    tolerance = 3e-6 + 3e-4 * here**2
    assert (np.abs(turned**2 - here**2) < tolerance).all()
    assert (np.abs(shuffled**2 - here**2) < tolerance).all()


def test_stop_returns_early_and_below(device):
    arms, normals = problems(300, 4, 7)
    full, _ = solve(device, arms, normals, mu=0.5)
    early, forces = solve(device, arms, normals, mu=0.5, stop=0.2)
    assert ((early <= 0.2) == (full <= 0.2)).all()
    assert (early >= full - 1e-3).all()
    np.testing.assert_allclose((forces[:, :4] * normals).sum((1, 2)), 1.0, atol=1e-5)


def test_decisions_are_those_of_the_whole_answer(device):
    arms, normals = problems(300, 3, 8)
    limit = 0.1
    full, _ = solve(device, arms, normals, mu=0.4)
    given = [wp.array(a, dtype=wp.vec3, device=device) for a in (arms, normals)]
    balanced = wp.empty(300, dtype=wp.bool, device=device)
    order = wp.empty((300, 6), dtype=wp.int32, device=device)
    wp.launch(_decide, 300, [*given, 0.4, limit], [balanced, order], device=device)
    clear = np.abs(full - limit) > 1e-4
    assert 30 < balanced.numpy().sum() < 270
    np.testing.assert_array_equal(balanced.numpy()[clear], full[clear] <= limit)
    np.testing.assert_array_equal(np.sort(order.numpy(), 1), np.tile(np.arange(6), (300, 1)))
    most = np.argmax(order.numpy() == 2, 1)  # +z: hardest where no normal points down
    down = -normals[..., 2].min(1)
    assert down[most == 0].mean() < down[most == 5].mean()


def test_never_improved_start_keeps_the_normal(device):
    """All normals alike: the first contact alone is already among the best; its force must be +n, not -n."""
    n = np.tile(np.array([0.0, 0.6, 0.8]), (1, 3, 1))
    norm, forces = solve(device, np.zeros((1, 3, 3)), n)
    assert norm[0] == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(forces[0].sum(0), [0.0, 0.6, 0.8], atol=1e-6)
    one, force = solve(device, np.array([[[0.1, 0, 0]]]), np.array([[[0.0, 0, 1]]]), mu=0.5)
    # a lone contact off the centroid cannot balance its own unit force
    assert one[0] >= 1.0 - 1e-6
    assert force[0, 0, 2] == pytest.approx(1.0, abs=1e-6)


def test_equal_contacts(device):
    for mu, edges in ((0.0, 0), (0.5, 8), (0.5, 0)):
        arms = np.tile(np.array([0.02, 0.01, -0.03]), (1, 6, 1))
        normals = np.tile(np.array([1.0, 0, 0]), (1, 6, 1))
        norm, forces = solve(device, arms, normals, mu=mu, edges=edges)
        assert np.isfinite(forces).all()
        # one force along the normal at a lever of 1e-2 |y - z| m, less what friction turns
        assert norm[0] == pytest.approx(residual(arms[0], normals[0], mu, edges or 96, SCALE), rel=2e-3)


@pytest.mark.parametrize(("mu", "edges"), [(0.0, 0), (0.5, 8), (0.5, 0)])
def test_opposite_contacts_balance(device, mu, edges):
    rng = np.random.default_rng(8)
    n = units(rng, 50, 1)
    arms = np.concatenate([-0.05 * n, 0.05 * n], 1)
    norm, forces = solve(device, arms, np.concatenate([n, -n], 1), mu=mu, edges=edges)
    assert norm.max() < 1e-5
    np.testing.assert_allclose(forces[:, 0], -forces[:, 1], atol=1e-5)
    np.testing.assert_allclose(forces[:, 0], 0.5 * n[:, 0], atol=1e-5)


def test_contacts_in_a_line_and_a_plane(device):
    """Rank-deficient Gram matrices: wrenches of parallel forces along one line."""
    x = np.linspace(-0.05, 0.05, 6)
    arms = np.column_stack([x, 0 * x, 0 * x])[None]
    normals = np.tile(np.array([0.0, 0, 1]), (1, 6, 1))
    normals[0, ::2] *= -1
    norm, forces = solve(device, arms, normals)
    assert norm[0] < 1e-3
    assert forces[0, :, 2].sum() == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("k", range(2, MAX_CONTACTS + 1))
def test_frictionless_bounds_the_exact_residual(device, k):
    """Exact with the smallest share where no contact is dropped, an upper bound otherwise."""
    arms, normals = problems(300, k, 20 + k)
    out = wp.empty(len(arms), dtype=wp.vec2, device=device)
    inputs = [wp.array(arms + 0.3, dtype=wp.vec3, device=device), wp.array(normals, dtype=wp.vec3, device=device)]
    wp.launch(_frictionless, len(arms), [*inputs, k, SCALE], [out], device=device)
    score, least = out.numpy().T
    exact, forces = solve(device, arms, normals)
    # the regularisation 1e-6 of the mean squared wrench moves small residuals by up to its root
    assert (score > exact - 3e-3).all()
    shares = (forces[:, :k] * normals).sum(-1).min(1)
    full = least > 1e-3
    assert full.sum() > 5
    np.testing.assert_allclose(score[full], exact[full], atol=3e-3)
    np.testing.assert_allclose(least[full], shares[full], atol=2e-3)
    assert (shares[least == 0] < 1e-3).all()


@pytest.mark.parametrize("k", [2, 3, 5])
def test_disturbance_solves_the_bounded_problem(device, k):
    rng = np.random.default_rng(k)
    n = 25
    arms = 0.04 * units(rng, n, k)
    normals = -arms / 0.04 + 0.6 * units(rng, n, k)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    turn = Rotation.random(n, rng=rng)
    axes = np.vstack([np.eye(3), -np.eye(3)])
    expected = [unresisted(arms[i], normals[i], 0.5, turn[i].apply(axes)) for i in range(n)]
    np.testing.assert_allclose(unheld(device, arms, normals, turn), expected, atol=4e-3)


def test_disturbance_of_simple_grasps(device):
    """Two fingers on a line through the centre of mass hold what a pull of 1 N asks; what is not held stays whole."""
    turn = Rotation.from_quat([[0, 0, 0, 1.0]])
    x = np.array([[[-0.03, 0, 0], [0.03, 0, 0]]])
    # a pull along x: one finger; along y or z: friction of both, 2 mu f_n >= 1 within the bound of 5
    assert unheld(device, x, -x / 0.03, turn)[0] < 0.01
    # no friction: nothing resists y and z
    assert unheld(device, x, -x / 0.03, turn, mu=1e-6)[0] == pytest.approx(1.0, abs=1e-3)
    # far from the centre of mass the torque of a sideways pull is not held by points on one line
    far = x + np.array([0, 0.3, 0])
    assert unheld(device, far, -x / 0.03, turn)[0] > 0.8
    # the bound binds: a pull that needs f_n = 1 / (2 mu) = 10 > 5 / 2 each
    assert unheld(device, x, -x / 0.03, turn, mu=0.05)[0] == pytest.approx(1 - 5 * 0.05, abs=0.01)


def test_disturbance_limit_only_ends_early(device):
    rng = np.random.default_rng(1)
    arms, normals = 0.04 * units(rng, 200, 3), units(rng, 200, 3)
    turn = Rotation.random(200, rng=rng)
    full, cut = unheld(device, arms, normals, turn), unheld(device, arms, normals, turn, limit=0.3)
    np.testing.assert_array_equal(full > 0.3, cut > 0.3)
    np.testing.assert_allclose(cut[full <= 0.3], full[full <= 0.3], atol=1e-6)
