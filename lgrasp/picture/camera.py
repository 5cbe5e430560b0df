"""Pinhole cameras: intrinsics, poses.

Camera frame: x to the right, y down, z forward. The centre of the pixel in row i and column j is at (j, i) of the
image. A depth is the z of what is seen [m], not the length of the ray.
"""

from dataclasses import dataclass

import numpy as np

from lgrasp.geometry.poses import pose_from_matrix


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera: pixel (j, i) = (fx x / z + cx, fy y / z + cy) of a point x y z in the camera frame."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def points(self, depth: np.ndarray) -> np.ndarray:
        """Points [m], shape (..., h, w, 3), in the camera frame, of depths [m], shape (..., h, w)."""
        x = (np.arange(self.width) - self.cx) / self.fx
        y = (np.arange(self.height)[:, None] - self.cy) / self.fy
        return np.stack([x * depth, y * depth, depth], axis=-1)


def central_camera(width: int, height: int, angle: float) -> Intrinsics:
    """Square pixels, the optical axis through the middle of the image; ``angle`` is that of its width [deg]."""
    f = float(0.5 * width / np.tan(np.radians(0.5 * angle)))
    return Intrinsics(width, height, f, f, 0.5 * (width - 1), 0.5 * (height - 1))


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Poses T_scene_camera, x y z [m] qw qx qy qz, shape (v, 7), of cameras at ``eye`` [m], shape (v, 3), that look at
    ``target`` [m], shape (3,) or (v, 3), neither straight above nor below; z of the scene is up in the image."""
    forward = target - eye
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    T = np.zeros((len(eye), 4, 4))
    T[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    T[:, :3, 3] = eye
    return pose_from_matrix(T)
