"""Exact images made realistic: noisy depths, slightly misaligned views, one merged cloud."""

from dataclasses import dataclass, replace

import numpy as np

from lgrasp.geometry.poses import pose_matrix
from lgrasp.scenes.params import CameraParams
from lgrasp.scenes.render import Images, image_normals
from lgrasp.scenes.schema import DEPTH_UNIT

_MOST_STEPS = 2**16 - 1  # that a file can hold


@dataclass(frozen=True)
class Merged:
    """The cloud of several views; n points in the scene frame."""

    points: np.ndarray
    """[m], shape (n, 3), f32."""
    normals: np.ndarray
    """Unit, estimated from the depth image, towards the camera, shape (n, 3), f32."""
    labels: np.ndarray
    """0 table, k + 1 object k, shape (n,), int32."""
    view: np.ndarray
    """Camera that saw each point, shape (n,), int32."""


def add_noise(images: Images, params: CameraParams, rng: np.random.Generator) -> Images:
    """Images with Gaussian noise of ``noise + noise_square * depth^2`` [m] on every depth, in steps of DEPTH_UNIT."""
    error = rng.standard_normal(images.depth.shape).astype(np.float32)
    depth = images.depth + error * (params.noise + params.noise_square * images.depth**2)
    steps = np.clip(np.rint(depth / DEPTH_UNIT), 1, _MOST_STEPS) * DEPTH_UNIT
    return replace(images, depth=np.where(images.depth > 0.0, steps, 0.0).astype(np.float32))


def draw_offsets(params: CameraParams, rng: np.random.Generator) -> np.ndarray:
    """Errors of the cameras' calibration: a displacement of each view [m], shape (v, 3), of one length, any way."""
    way = rng.standard_normal((params.views, 3))
    return params.calibration * way / np.linalg.norm(way, axis=1)[:, None]


def merge_views(images: Images, offsets: np.ndarray, params: CameraParams, device: str = "cpu") -> Merged:
    """All points of all views with a normal, each view displaced; of a cube of side ``voxel`` one point is kept.

    Args:
        offsets: displacement of each view [m], shape (v, 3).
    """
    normals = image_normals(images, params.window, device)
    v, i, j = np.nonzero((images.depth > 0.0) & (np.abs(normals).sum(-1) > 0.5))
    T = pose_matrix(images.pose)
    local = images.intrinsics.points(images.depth)[v, i, j]
    points = np.einsum("nab,nb->na", T[v, :3, :3], local) + (T[:, :3, 3] + offsets)[v]
    kept = _one_per_voxel(points, params.voxel)
    v, i, j = v[kept], i[kept], j[kept]
    return Merged(
        points[kept].astype(np.float32), normals[v, i, j], images.labels[v, i, j].astype(np.int32), v.astype(np.int32)
    )


def _one_per_voxel(points: np.ndarray, voxel: float) -> np.ndarray:
    """Indices of the first point in every cube, rising."""
    if voxel <= 0.0 or not len(points):
        return np.arange(len(points))
    cell = np.floor(points / voxel).astype(np.int64)
    cell -= cell.min(axis=0)
    sides = cell.max(axis=0) + 1
    key = (cell[:, 0] * sides[1] + cell[:, 1]) * sides[2] + cell[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])
