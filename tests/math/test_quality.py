"""Ferrari-Canny bound against closed forms and the exact 6-D hull."""

import numpy as np
import warp as wp
from support.wrench import epsilon

from lgrasp.math.limits import MAX_CONTACTS
from lgrasp.math.quality import epsilon_bound
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def _epsilon(
    arm: wp.array2d(dtype=wp.vec3),
    normal: wp.array2d(dtype=wp.vec3),
    k: wp.int32,
    mu: wp.float32,
    radius: wp.float32,
    seed: wp.int32,
    bound_out: wp.array(dtype=wp.float32),
):
    i = wp.tid()
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    for c in range(k):
        arms[c] = arm[i, c]
        normals[c] = normal[i, c]
    bound_out[i] = epsilon_bound(arms, normals, k, mu, radius, wp.rand_init(seed, i))


def bound(device, arms, normals, mu=0.5, radius=0.05, seed=3) -> np.ndarray:
    """Upper bounds (n,) of epsilon for arms and normals (n, k, 3)."""
    n, k, _ = arms.shape
    pad = ((0, 0), (0, MAX_CONTACTS - k), (0, 0))
    out = wp.empty(n, dtype=wp.float32, device=device)
    inputs = [
        wp.array(np.pad(arms, pad).astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(np.pad(normals, pad).astype(np.float32), dtype=wp.vec3, device=device),
        *(k, mu, radius, seed),
    ]
    wp.launch(_epsilon, n, inputs, [out], device=device)
    return out.numpy()


def grasps(n: int, k: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Contacts on a 5 cm ball, normals roughly inward."""
    rng = np.random.default_rng(seed)
    out = rng.normal(size=(n, k, 3))
    out /= np.linalg.norm(out, axis=-1, keepdims=True)
    normals = -out + 0.25 * rng.normal(size=(n, k, 3))
    return 0.05 * out, normals / np.linalg.norm(normals, axis=-1, keepdims=True)


RESOLUTION = 2.5e-4
"""The kernel returns smaller values as 0."""


def test_bound_is_above_and_tight(device):
    share = []
    for k in (3, 4, 5, 6):
        arms, normals = grasps(30, k, k)
        exact = np.array([epsilon(a, m, 0.5, 0.05) for a, m in zip(arms, normals, strict=True)])
        found = bound(device, arms, normals)
        assert (found > exact - 1e-6)[exact > RESOLUTION].all()
        assert (found[exact == 0] == 0).all()
        closed = exact > 0.003
        share.append(found[closed] / exact[closed] - 1)
    share = np.concatenate(share)
    assert len(share) > 50
    print(f"epsilon bound above exact: median {np.median(share):.1e}, 95th {np.quantile(share, 0.95):.1e}")
    assert np.median(share) < 1e-4
    assert np.quantile(share, 0.95) < 0.02


def test_grasp_that_is_not_closed_has_none(device):
    arms, normals = grasps(50, 3, 0)
    normals[..., 2] = -0.9  # every force pulls down
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    assert (bound(device, arms, normals, mu=0.2) == 0).all()
    # two point contacts cannot resist a torque about the line between them
    two = np.array([[[0.05, 0, 0], [-0.05, 0, 0]]])
    assert bound(device, two, -two / 0.05).max() == 0


def test_octahedral_grasp_closed_form(device):
    """Six contacts on the axes of a ball: degenerate facets; the value does not depend on the ball's size."""
    axes = np.vstack([np.eye(3), -np.eye(3)])
    exact = epsilon(axes, -axes, 0.5, 1.0)
    for r in (0.02, 0.2):
        found = bound(device, r * axes[None], -axes[None], radius=r)[0]
        assert exact - 1e-5 <= found <= exact * 1.05


def test_frictionless_is_zero_on_a_ball(device):
    arms, _ = grasps(20, 6, 1)
    assert bound(device, arms, -arms / 0.05, mu=0.0).max() == 0


def test_same_seed_same_bound(device):
    arms, normals = grasps(30, 4, 2)
    np.testing.assert_array_equal(bound(device, arms, normals), bound(device, arms, normals))
