"""Poses as other formats write them: inverses, products, Euler angles. All in float64.

A pose is x y z [m] qw qx qy qz, shape [..., 7]; a quaternion is qw qx qy qz, unit, qw >= 0, shape [..., 4].
"""

import numpy as np


def canonical(quaternion: np.ndarray) -> np.ndarray:
    """The quaternions of unit length with qw >= 0 that mean the same rotations, shape [..., 4]."""
    q = np.asarray(quaternion, np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``T_a T_b`` of poses of one shape, [..., 7]."""
    q, p = canonical(a[..., 3:]), canonical(b[..., 3:])
    w = q[..., :1] * p[..., :1] - (q[..., 1:] * p[..., 1:]).sum(-1, keepdims=True)
    v = q[..., :1] * p[..., 1:] + p[..., :1] * q[..., 1:] + np.cross(q[..., 1:], p[..., 1:])
    position = np.asarray(a[..., :3], np.float64) + _rotate(q, np.asarray(b[..., :3], np.float64))
    return np.concatenate([position, canonical(np.concatenate([w, v], -1))], -1)


def inverse(pose: np.ndarray) -> np.ndarray:
    """``T^-1``, shape [..., 7]."""
    q = canonical(pose[..., 3:]) * [1, -1, -1, -1]
    return np.concatenate([-_rotate(q, np.asarray(pose[..., :3], np.float64)), q], -1)


def pose_from_matrix(T: np.ndarray) -> np.ndarray:
    """Poses, shape [n, 7], of homogeneous transforms, shape [n, 4, 4]."""
    from scipy.spatial.transform import Rotation

    quaternion = Rotation.from_matrix(T[:, :3, :3]).as_quat(scalar_first=True)
    return np.concatenate([T[:, :3, 3], canonical(quaternion)], -1)


def euler_from_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """Angles (a, b, c) [rad] about the fixed axes x, then y, then z: R = Rz(c) Ry(b) Rx(a); shape [..., 3].

    The convention ``sxyz``. In gimbal lock (b = +-90 deg) one of the many answers is given: a is measured in the frame
    that c turned, so the three belong together however ill-defined each is.
    """
    w, x, y, z = np.moveaxis(canonical(quaternion), -1, 0)
    r00, r10, r20 = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)
    r01, r11 = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z)
    r02, r12 = 2 * (x * z + w * y), 2 * (y * z - w * x)
    c = np.arctan2(r10, r00)
    sin, cos = np.sin(c), np.cos(c)
    a = np.arctan2(sin * r02 - cos * r12, cos * r11 - sin * r01)
    b = np.arctan2(-r20, cos * r00 + sin * r10)
    return np.stack([a, b, c], -1)


def quaternion_from_euler(angles: np.ndarray) -> np.ndarray:
    """Quaternions, shape [..., 4], of angles in the convention of :func:`euler_from_quaternion`, shape [..., 3]."""
    a, b, c = np.moveaxis(np.asarray(angles, np.float64) / 2, -1, 0)
    sa, sb, sc, ca, cb, cc = np.sin(a), np.sin(b), np.sin(c), np.cos(a), np.cos(b), np.cos(c)
    w, x = ca * cb * cc + sa * sb * sc, sa * cb * cc - ca * sb * sc
    y, z = ca * sb * cc + sa * cb * sc, ca * cb * sc - sa * sb * cc
    return canonical(np.stack([w, x, y, z], -1))


def _rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    t = 2 * np.cross(q[..., 1:], v)
    return v + q[..., :1] * t + np.cross(q[..., 1:], t)
