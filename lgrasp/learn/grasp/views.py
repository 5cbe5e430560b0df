"""Clouds of objects as cameras see them, and the frame that a network sees a cloud in."""

from typing import NamedTuple

import numpy as np

from lgrasp.learn.examples import CAMERA, seen_cloud
from lgrasp.refine.surface import farthest_points
from lgrasp.scenes.params import CameraParams

SIDES = {"one view": 1, "two views": 2, "full": 8}
"""Cameras by what a cloud is called."""
_DRAWN = 4096  # points that are thinned


class CloudView(NamedTuple):
    """A cloud of n points in its own frame: about its middle, z against the way that it was seen along."""

    points: np.ndarray
    """[m], (n, 3) f32, evenly spread."""
    normals: np.ndarray
    """(n, 3) f32."""
    R: np.ndarray
    """Axes of the frame in that of the object as columns, (3, 3)."""
    t: np.ndarray
    """Its origin there [m], (3,)."""


def camera(sides: int) -> CameraParams:
    """Depth cameras at some sides, with noise of 1 mm and their places known to 1 mm."""
    return CAMERA.model_copy(update={"views": sides, "calibration": 0.001})


def draw_views(
    vertices: np.ndarray, faces: np.ndarray, count: int, points: int, rng: np.random.Generator, device: str = "cpu"
) -> list[CloudView]:
    """Views, with so many points each, of a mesh that is centred: every second from one side, the others from two or
    from all around in turn."""
    sides = [SIDES["one view"], SIDES["full"], SIDES["one view"], SIDES["two views"]]
    clouds = (seen_cloud(vertices, faces, camera(sides[k % 4]), rng, device) for k in range(count))
    return [make_view(cloud.points, cloud.normals, points) for cloud in clouds]


def make_view(points: np.ndarray, normals: np.ndarray, count: int) -> CloudView:
    """``count`` points of a cloud, which turn and move with it.

    z is the mean normal, x the longest extent across it, so that most points lie at x > 0.

    Args:
        points: (n, 3) [m]. normals: outward, (n, 3).
    """
    drawn = np.random.default_rng(0).permutation(len(points))[:_DRAWN]
    points, normals = np.asarray(points, float)[drawn], np.asarray(normals, float)[drawn]
    kept = farthest_points(points, count)
    points, normals = points[kept], normals[kept]
    centre = points.mean(0)
    local = points - centre
    z = normals.mean(0)
    z = z / max(float(np.linalg.norm(z)), 1e-9)
    across = local - np.outer(local @ z, z)
    x = np.linalg.eigh(across.T @ across)[1][:, 2]
    x = x * (1.0 if np.sum((local @ x) ** 3) >= 0 else -1.0)
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    R = np.column_stack([x, np.cross(z, x), z])
    return CloudView((local @ R).astype(np.float32), (normals @ R).astype(np.float32), R, centre)
