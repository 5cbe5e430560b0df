"""Renders depth cameras that see meshes: depths, labels, normals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.geometry.poses import pose_matrix
from lgrasp.runtime.device import start
from lgrasp.scenes import render_kernels as kernels
from lgrasp.scenes.camera import Intrinsics

NOTHING, TABLE = -1, 0
"""Labels of pixels that see nothing, and of the table; object k is k + 1."""

_FAR = 10.0  # [m]
_SLOPE = 6.0  # tangent of the steepest angle to the image plane at which neighbouring pixels still lie on one surface


@dataclass(frozen=True)
class LabelledMesh:
    """A triangle mesh in the scene frame, every face with a label."""

    vertices: np.ndarray
    """[m], shape (v, 3)."""
    faces: np.ndarray
    """Shape (f, 3)."""
    labels: np.ndarray
    """Shape (f,)."""


@dataclass(frozen=True)
class Images:
    """Images of v cameras."""

    intrinsics: Intrinsics
    pose: np.ndarray
    """T_scene_camera, x y z [m] qw qx qy qz, shape (v, 7)."""
    depth: np.ndarray
    """Along the optical axis [m], shape (v, h, w), f32; 0 where nothing is seen."""
    labels: np.ndarray
    """Shape (v, h, w), int32; ``NOTHING`` where nothing is seen."""


def table_surface(side: float) -> LabelledMesh:
    """A square table about the origin, its top in the plane z = 0, seen from above."""
    x = 0.5 * side
    corners = np.array([[-x, -x, 0.0], [x, -x, 0.0], [x, x, 0.0], [-x, x, 0.0]])
    return LabelledMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.full(2, TABLE))


def join_surfaces(surfaces: Sequence[LabelledMesh]) -> LabelledMesh:
    """Several surfaces as one."""
    first = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    return LabelledMesh(
        np.concatenate([s.vertices for s in surfaces]),
        np.concatenate([s.faces + at for s, at in zip(surfaces, first, strict=False)]),
        np.concatenate([s.labels for s in surfaces]),
    )


def render(surface: LabelledMesh, intrinsics: Intrinsics, pose: np.ndarray, device: str = "cpu") -> Images:
    """Exact depths and labels from v cameras.

    Args:
        pose: T_scene_camera, x y z [m] qw qx qy qz, shape (v, 7).
    """
    start()
    with wp.ScopedDevice(device):
        mesh = wp.Mesh(
            wp.array(np.asarray(surface.vertices, np.float32), dtype=wp.vec3),
            wp.array(np.asarray(surface.faces, np.int32).ravel(), dtype=wp.int32),
        )
        shape = (len(pose), intrinsics.height, intrinsics.width)
        depth, label = wp.empty(shape, dtype=wp.float32), wp.empty(shape, dtype=wp.int32)
        camera = np.asarray(pose, np.float32)[:, [0, 1, 2, 4, 5, 6, 3]]  # Warp writes quaternions x y z w
        inputs = [
            mesh.id,
            wp.array(np.asarray(surface.labels, np.int32), dtype=wp.int32),
            wp.vec2(intrinsics.fx, intrinsics.fy),
            wp.vec2(intrinsics.cx, intrinsics.cy),
            _FAR,
            wp.array(np.ascontiguousarray(camera), dtype=wp.transform),
        ]
        wp.launch(kernels.cast_rays, shape, inputs, [depth, label])
        return Images(intrinsics, np.asarray(pose, float), depth.numpy(), label.numpy())


def image_normals(images: Images, window: int, device: str = "cpu") -> np.ndarray:
    """Unit normals in the scene frame from the depths alone, towards the camera, shape (v, h, w, 3), f32.

    Zero where too few pixels around lie on the same surface.

    Args:
        window: Pixels to each side through which a plane is laid.
    """
    start()
    points = images.intrinsics.points(images.depth).astype(np.float32)
    with wp.ScopedDevice(device):
        out = wp.empty(images.depth.shape, dtype=wp.vec3)
        step = _SLOPE / min(images.intrinsics.fx, images.intrinsics.fy)
        inputs = [wp.array(points, dtype=wp.vec3), window, step]
        wp.launch(kernels.fit_normals, images.depth.shape, inputs, [out])
        normals = out.numpy()
    R = pose_matrix(images.pose)[:, :3, :3].astype(np.float32)
    return np.einsum("vab,vhwb->vhwa", R, normals)
