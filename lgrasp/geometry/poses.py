"""Poses as rows of seven numbers: the only place that knows the order of a quaternion.

Stored: x y z [m] qw qx qy qz, shape [..., 7], unit, qw >= 0, as in files; products and inverses are float64.
Device: x y z [m] qx qy qz qw, as in a Warp transform; functions for it begin with ``device_``.
Poses in torch are R, t pairs: :mod:`lgrasp.geometry.rotations`.
"""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # scipy is slow to load
    from scipy.spatial.transform import Rotation

TO_DEVICE, TO_STORED = [0, 1, 2, 4, 5, 6, 3], [0, 1, 2, 6, 3, 4, 5]
"""Columns of the other kind of pose, in order."""


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
    position = np.asarray(a[..., :3], np.float64) + rotated(q, np.asarray(b[..., :3], np.float64))
    return np.concatenate([position, canonical(np.concatenate([w, v], -1))], -1)


def inverse(pose: np.ndarray) -> np.ndarray:
    """``T^-1``, shape [..., 7]."""
    q = canonical(pose[..., 3:]) * [1, -1, -1, -1]
    return np.concatenate([-rotated(q, np.asarray(pose[..., :3], np.float64)), q], -1)


def shifted(pose: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Poses of frames that are at ``by`` [m] in those of ``pose``, shape [..., 3], and not turned against them."""
    out = np.array(pose, np.float64)
    out[..., :3] += rotated(canonical(out[..., 3:]), by)
    return out


def pose_matrix(pose: np.ndarray) -> np.ndarray:
    """Homogeneous transforms of poses.

    Args:
        pose: x y z [m] qw qx qy qz, shape [..., 7]; quaternions of any positive length. NaN gives NaN.

    Returns:
        Shape [..., 4, 4], dtype of ``pose``; float64 for integers.
    """
    pose = np.asarray(pose)
    pose = pose if pose.dtype.kind == "f" else pose.astype(float)
    w, x, y, z = np.moveaxis(pose[..., 3:] / np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True), -1, 0)
    T = np.zeros((*pose.shape[:-1], 4, 4), dtype=pose.dtype)
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    T[..., 2, 0], T[..., 2, 1], T[..., 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    T[..., :3, 3] = pose[..., :3]
    T[..., 3, 3] = 1
    return T


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


def device_pose(position: np.ndarray, rotation: "Rotation") -> np.ndarray:
    """Device poses, shape [n, 7], of positions, shape [n, 3], and rotations, n of them."""
    return np.concatenate([position, rotation.as_quat()], 1)


def device_rotation(pose: np.ndarray) -> "Rotation":
    """Rotations of device poses, shape [n, 7]."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(pose[:, 3:])


def device_from_stored(pose: np.ndarray) -> np.ndarray:
    """Device poses, shape [n, 7], float32, of stored ones."""
    return np.ascontiguousarray(np.asarray(pose)[:, TO_DEVICE], np.float32)


def device_from_matrix(T: np.ndarray) -> np.ndarray:
    """Device poses, shape [n, 7], float32, of homogeneous transforms, shape [n, 4, 4]."""
    return np.concatenate([T[:, :3, 3], _quaternions(T[:, :3, :3])], 1).astype(np.float32)


def _quaternions(R: np.ndarray) -> np.ndarray:
    """Unit quaternions qx qy qz qw, shape [n, 4], of rotation matrices, shape [n, 3, 3].

    Of the four rows of the matrix 4 q q^T the one with the largest diagonal entry, so that nothing small is divided by.
    """
    d, trace = np.diagonal(R, axis1=1, axis2=2), np.trace(R, axis1=1, axis2=2)
    outer = np.empty((len(R), 4, 4))
    outer[:, :3, :3] = R + np.swapaxes(R, 1, 2)
    outer[:, :3, 3] = outer[:, 3, :3] = np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1
    )
    outer[:, range(3), range(3)] = 1 - trace[:, None] + 2 * d
    outer[:, 3, 3] = 1 + trace
    best = np.argmax(np.column_stack([d, trace]), 1)
    q = outer[np.arange(len(R)), best]
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def device_matrix(pose: np.ndarray) -> np.ndarray:
    """Homogeneous transforms, shape [n, 4, 4], float64, of device poses, shape [n, 7]."""
    T = np.broadcast_to(np.eye(4), (len(pose), 4, 4)).copy()
    T[:, :3, :3] = device_rotation(pose).as_matrix()
    T[:, :3, 3] = pose[:, :3]
    return T


def device_inverse(pose: np.ndarray) -> np.ndarray:
    """``T^-1`` of device poses, shape [n, 7], float32."""
    back = device_rotation(pose).inv()
    return device_pose(-back.apply(pose[:, :3]), back).astype(np.float32)


def user_poses(pose: np.ndarray, center: np.ndarray) -> np.ndarray:
    """T_hand_object of the object's user frame, stored as in shards, shape [n, 7], float32.

    Args:
        pose: T_hand_object of the object's internal frame, device pose, shape [n, 7].
        center: origin of the internal frame in the user's frame [m], shape [3].
    """
    x, y, z, w = pose[:, 3:].T.astype(float)
    scale = np.where(w < 0, -1.0, 1.0) / np.sqrt(x * x + y * y + z * z + w * w)
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    a, b, c = map(float, center)
    # R(q) center = center + 2 v x (v x center + w center)
    i, j, k = y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c
    out = np.empty((len(pose), 7), np.float32)
    out[:, 0] = pose[:, 0] - (a + 2 * (y * k - z * j))
    out[:, 1] = pose[:, 1] - (b + 2 * (z * i - x * k))
    out[:, 2] = pose[:, 2] - (c + 2 * (x * j - y * i))
    out[:, 3], out[:, 4], out[:, 5], out[:, 6] = w, x, y, z
    return out


def internal_poses(stored: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Inverse of :func:`user_poses`: device poses of the object's internal frame, shape [n, 7], float32."""
    from scipy.spatial.transform import Rotation

    pose = np.asarray(stored, float)
    turned = Rotation.from_quat(pose[:, 3:], scalar_first=True)
    return device_pose(pose[:, :3] + turned.apply(center), turned).astype(np.float32)


def shortest_rotation(z: np.ndarray) -> "Rotation":
    """The shortest rotations that turn the third axis to unit vectors, shape [n, 3]."""
    from scipy.spatial.transform import Rotation

    q = np.stack([-z[:, 1], z[:, 0], np.zeros(len(z)), 1 + z[:, 2]], 1)
    q[q[:, 3] < 1e-9] = [1.0, 0, 0, 0]
    return Rotation.from_quat(q)


def rotated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) turned by unit quaternions w x y z, (..., 4)."""
    t = 2 * np.cross(q[..., 1:], v)
    return v + q[..., :1] * t + np.cross(q[..., 1:], t)
