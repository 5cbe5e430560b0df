"""Directions and rotations."""

import numpy as np
import pytest
import warp as wp
from scipy import stats
from scipy.spatial.transform import Rotation
from support.directions import decode
from support.directions import normal_bin as reference_bin

from lgrasp.math.transforms import (
    NORMAL_BINS,
    decode_normal,
    encode_normal,
    normal_bin,
    random_rotation,
    rotation_between,
    tangent,
)
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def _directions(
    n: wp.array(dtype=wp.vec3),
    code_out: wp.array(dtype=wp.int32),
    back_out: wp.array(dtype=wp.vec3),
    bin_out: wp.array(dtype=wp.int32),
    tangent_out: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    code_out[i] = encode_normal(n[i])
    back_out[i] = decode_normal(code_out[i])
    bin_out[i] = normal_bin(n[i])
    tangent_out[i] = tangent(n[i])


@wp.kernel
def _rotations(seed: wp.int32, q_out: wp.array(dtype=wp.quat)):
    i = wp.tid()
    q_out[i] = random_rotation(wp.rand_init(seed, i))


@wp.kernel
def _between(a: wp.array(dtype=wp.vec3), b: wp.array(dtype=wp.vec3), q_out: wp.array(dtype=wp.quat)):
    i = wp.tid()
    q_out[i] = rotation_between(a[i], b[i])


def units(n: int, seed: int) -> np.ndarray:
    v = np.random.default_rng(seed).normal(size=(n, 3))
    special = [s * np.eye(3)[i] for i in range(3) for s in (-1, 1)]
    special += [np.array([x, y, z]) / 3**0.5 for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    special += [np.array([x, y, 0]) / 2**0.5 for x in (-1, 1) for y in (-1, 1)]
    return np.vstack([special, v / np.linalg.norm(v, axis=1, keepdims=True)]).astype(np.float32)


@pytest.fixture
def coded(device):
    n = units(200_000, 0)
    out = [wp.empty(len(n), dtype=t, device=device) for t in (wp.int32, wp.vec3, wp.int32, wp.vec3)]
    wp.launch(_directions, len(n), [wp.array(n, dtype=wp.vec3, device=device)], out, device=device)
    return (n, *(a.numpy() for a in out))


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees between rows; accurate near 0."""
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(a.astype(float) - b.astype(float), axis=1) / 2, 0, 1)))


def test_normals_survive_16_bits(coded):
    n, code, back, _, _ = coded
    assert code.min() >= 0
    assert code.max() < 2**16
    np.testing.assert_allclose(back, decode(code), atol=1e-6)
    error = angle(n, back)
    print(f"16-bit normals: mean {error.mean():.3f}, worst {error.max():.3f} degrees")
    assert error.max() < 0.65


def test_bins_are_octahedral_and_even(coded):
    n, _, _, found, _ = coded
    assert (found == reference_bin(n.astype(float))).mean() > 0.9999  # float32 at bin edges
    count = np.bincount(found, minlength=NORMAL_BINS)
    assert len(count) == NORMAL_BINS
    assert count.min() > 0.3 * len(n) / NORMAL_BINS
    centre = np.array([n[found == b].mean(0) for b in range(NORMAL_BINS)])
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    assert angle(n, centre[found]).max() < 29  # corner of the widest bin


def test_edges_of_bins_are_far_from_axes():
    """Fingers that bend in a plane of the base frame have such normals, and rounding must not decide on their bins."""
    axes = np.vstack([np.eye(3), -np.eye(3)])
    across = np.roll(axes, 1, 1)
    for roll in np.linspace(0, 2 * np.pi, 24, endpoint=False):
        side = np.cos(roll) * across + np.sin(roll) * np.cross(axes, across)
        tilted = np.cos(np.radians(7.5)) * axes + np.sin(np.radians(7.5)) * side
        np.testing.assert_array_equal(reference_bin(tilted), reference_bin(axes))


def test_tangent_is_unit_and_orthogonal(coded):
    n, *_, t = coded
    np.testing.assert_allclose(np.linalg.norm(t, axis=1), 1, atol=1e-6)
    assert np.abs((n * t).sum(1)).max() < 1e-6


def test_random_rotations_are_uniform(device):
    q = wp.empty(40_000, dtype=wp.quat, device=device)
    wp.launch(_rotations, len(q), [7], [q], device=device)
    q = q.numpy()
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-6)
    # every component of a uniform unit quaternion: density 2/pi sqrt(1 - x^2)
    cdf = lambda x: 0.5 + (x * np.sqrt(1 - x * x) + np.arcsin(x)) / np.pi  # noqa: E731
    for c in range(4):
        assert stats.kstest(q[:, c], cdf).pvalue > 1e-3
    # images of an axis are uniform on the sphere, the angle has density (1 - cos) / pi
    R = Rotation.from_quat(q)
    for axis in np.eye(3):
        for c in R.apply(axis).T:
            assert stats.kstest(c, stats.uniform(-1, 2).cdf).pvalue > 1e-3
    turn = R.magnitude()
    assert stats.kstest(turn, lambda a: (a - np.sin(a)) / np.pi).pvalue > 1e-3


def test_rotation_between_is_the_shortest(device):
    rng = np.random.default_rng(4)
    a, b = units(5000, 1), units(5000, 2)
    near = [a, a, a, a]
    tiny = [rng.normal(size=a.shape) * s for s in (0.0, 1e-7, 1e-4, 3e-3)]
    opposite = [-x + t for x, t in zip(near, tiny, strict=True)]
    same = [x + t for x, t in zip(near, tiny, strict=True)]
    a, b = np.vstack([a, *near, *near]), np.vstack([b, *opposite, *same])
    b = (b / np.linalg.norm(b, axis=1, keepdims=True)).astype(np.float32)
    q = wp.empty(len(a), dtype=wp.quat, device=device)
    inputs = [wp.array(a, dtype=wp.vec3, device=device), wp.array(b, dtype=wp.vec3, device=device)]
    wp.launch(_between, len(a), inputs, [q], device=device)
    q = q.numpy().astype(float)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-5)
    R = Rotation.from_quat(q)
    assert angle(R.apply(a), b).max() < 0.1
    assert np.abs(np.degrees(R.magnitude()) - angle(a, b)).max() < 0.1
