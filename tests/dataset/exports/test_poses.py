"""Rotations against SciPy, gimbal lock included."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from lgrasp.geometry.poses import (
    canonical,
    compose,
    euler_from_quaternion,
    inverse,
    pose_from_matrix,
    quaternion_from_euler,
)

ANGLES = st.one_of(st.floats(-7, 7), st.sampled_from([0.0, np.pi / 2, -np.pi / 2, np.pi, -np.pi]))
TINY = st.sampled_from([0.0, 1e-9, -1e-8, 1e-7, 1e-5])
POSES = arrays(np.float64, 7, elements=st.floats(-2, 2)).filter(lambda p: np.linalg.norm(p[3:]) > 1e-3)


def matrix(quaternion) -> np.ndarray:
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


def homogeneous(pose) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = matrix(pose[3:]), pose[:3]
    return T


@settings(deadline=None, max_examples=60)
@given(POSES)
def test_euler_angles_mean_the_rotation(pose):
    quaternion = canonical(pose[3:])
    angles = euler_from_quaternion(quaternion)
    np.testing.assert_allclose(Rotation.from_euler("xyz", angles).as_matrix(), matrix(quaternion), atol=1e-9)
    np.testing.assert_allclose(matrix(quaternion_from_euler(angles)), matrix(quaternion), atol=1e-9)
    assert abs(angles[1]) <= np.pi / 2 + 1e-12


@settings(deadline=None, max_examples=60)
@given(ANGLES, ANGLES, TINY, st.sampled_from([-1, 1]))
def test_euler_angles_in_and_near_gimbal_lock(a, c, off, side):
    rotation = Rotation.from_euler("xyz", [a, side * (np.pi / 2 - off), c])
    # as a shard holds it: float32
    quaternion = canonical(rotation.as_quat(scalar_first=True).astype("f4"))
    angles = euler_from_quaternion(quaternion)
    np.testing.assert_allclose(Rotation.from_euler("xyz", angles).as_matrix(), matrix(quaternion), atol=1e-7)


@settings(deadline=None, max_examples=40)
@given(ANGLES, ANGLES, ANGLES)
def test_quaternions_of_euler_angles(a, b, c):
    quaternion = quaternion_from_euler(np.array([a, b, c]))
    np.testing.assert_allclose(matrix(quaternion), Rotation.from_euler("xyz", [a, b, c]).as_matrix(), atol=1e-12)
    assert quaternion[0] >= 0


@settings(deadline=None, max_examples=40)
@given(POSES, POSES)
def test_products_and_inverses(a, b):
    np.testing.assert_allclose(homogeneous(compose(a, b)), homogeneous(a) @ homogeneous(b), atol=1e-9)
    np.testing.assert_allclose(homogeneous(inverse(a)), np.linalg.inv(homogeneous(a)), atol=1e-9)
    np.testing.assert_allclose(homogeneous(pose_from_matrix(homogeneous(a)[None])[0]), homogeneous(a), atol=1e-9)
    assert compose(a, b)[3] >= 0
