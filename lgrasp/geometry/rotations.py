"""Rotations and rigid motions in torch: 6D representation, exponential, quaternions."""

import torch

_SMALL_ANGLE = 1.0e-4  # [rad²]
"""Squared angles below this take series; the first term left out is then below 1e-17."""


def skew(v: torch.Tensor) -> torch.Tensor:
    """Matrices [v]x (..., 3, 3) with [v]x w = v x w, of vectors (..., 3)."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape[:-1], 3, 3)


def matrix_from_sixd(r: torch.Tensor) -> torch.Tensor:
    """Rotations (..., 3, 3) of 6D vectors (..., 6): two columns, made orthonormal by Gram and Schmidt."""
    a, b = r[..., :3], r[..., 3:]
    x = a / a.norm(dim=-1, keepdim=True)
    b = b - (x * b).sum(-1, keepdim=True) * x
    y = b / b.norm(dim=-1, keepdim=True)
    return torch.stack([x, y, torch.linalg.cross(x, y)], -1)


def sixd_from_matrix(R: torch.Tensor) -> torch.Tensor:
    """6D vectors (..., 6) of rotations (..., 3, 3): the first two columns."""
    return torch.cat([R[..., 0], R[..., 1]], -1)


def so3_exp(w: torch.Tensor) -> torch.Tensor:
    """Rotations (..., 3, 3) about axes and by angles of rotation vectors (..., 3) [rad]; smooth at 0."""
    s = (w * w).sum(-1)[..., None, None]
    small = s < _SMALL_ANGLE
    a2 = torch.where(small, torch.ones_like(s), s)  # keeps the unused branch, and its derivative, finite
    a = a2.sqrt()
    sine = torch.where(small, 1 - s / 6 * (1 - s / 20 * (1 - s / 42)), torch.sin(a) / a)
    cosine = torch.where(small, 0.5 * (1 - s / 12 * (1 - s / 30 * (1 - s / 56))), (1 - torch.cos(a)) / a2)
    K = skew(w)
    return torch.eye(3, dtype=w.dtype, device=w.device) + sine * K + cosine * (K @ K)


def matrix_from_quaternion(q: torch.Tensor) -> torch.Tensor:
    """Rotations (..., 3, 3) of unit quaternions (..., 4) x y z w."""
    x, y, z, w = q.unbind(-1)
    a = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    b = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    c = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return torch.stack([*a, *b, *c], -1).reshape(*q.shape[:-1], 3, 3)


def quaternion_from_matrix(R: torch.Tensor) -> torch.Tensor:
    """Unit quaternions (..., 4) x y z w with w >= 0 of rotations (..., 3, 3)."""
    a, b, c = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    # four times the products of q's components with its largest one
    xx, yy, zz, ww = 1 + a - b - c, 1 - a + b - c, 1 - a - b + c, 1 + a + b + c
    xy, xz, yz = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    xw, yw, zw = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    rows = torch.stack([xx, xy, xz, xw, xy, yy, yz, yw, xz, yz, zz, zw, xw, yw, zw, ww], -1)
    largest = torch.stack([xx, yy, zz, ww], -1).argmax(-1, keepdim=True)  # (..., 1)
    rows = rows.reshape(*R.shape[:-2], 4, 4)
    q = torch.take_along_dim(rows, largest[..., None], -2)[..., 0, :]
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[..., 3:] < 0, -q, q)


def motion_from_pose(pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """R (..., 3, 3) and t (..., 3) [m] of device poses (..., 7): x y z qx qy qz qw."""
    return matrix_from_quaternion(pose[..., 3:]), pose[..., :3]


def pose_from_motion(R: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
    """Device poses (..., 7) of rotations (..., 3, 3) and positions (..., 3) [m]."""
    return torch.cat([t, quaternion_from_matrix(R)], -1)


def inverse_motion(R: torch.Tensor, t: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The inverse of x -> R x + t, of the same shapes."""
    back = R.mT
    return back, -(back @ t[..., None])[..., 0]
