"""Depth and label images of meshes, by rays."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import warp as wp

from lgrasp.geometry.poses import device_from_stored
from lgrasp.picture.camera import Intrinsics
from lgrasp.runtime.device import KERNEL_OPTIONS, start
from lgrasp.runtime.fetch import to_numpy

NOTHING = -1
"""Label of pixels that see nothing."""

_FAR = 10.0  # [m]

wp.set_module_options(KERNEL_OPTIONS)


class LabelledMesh(NamedTuple):
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


def join_surfaces(surfaces: Sequence[LabelledMesh]) -> LabelledMesh:
    """Several surfaces as one."""
    first = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    moved = (s._replace(faces=s.faces + at) for s, at in zip(surfaces, first, strict=False))
    return LabelledMesh(*map(np.concatenate, zip(*moved, strict=True)))


def render(surface: LabelledMesh, intrinsics: Intrinsics, pose: np.ndarray, device: str = "cpu") -> Images:
    """Exact depths and labels from v cameras at T_scene_camera, x y z [m] qw qx qy qz, shape (v, 7)."""
    start()
    mesh = wp.Mesh(
        wp.array(np.asarray(surface.vertices, np.float32), dtype=wp.vec3, device=device),
        wp.array(np.asarray(surface.faces, np.int32).ravel(), dtype=wp.int32, device=device),
    )
    shape = (len(pose), intrinsics.height, intrinsics.width)
    depth, label = wp.empty(shape, dtype=wp.float32, device=device), wp.empty(shape, dtype=wp.int32, device=device)
    inputs = [
        mesh.id,
        wp.array(np.asarray(surface.labels, np.int32), dtype=wp.int32, device=device),
        wp.vec2(intrinsics.fx, intrinsics.fy),
        wp.vec2(intrinsics.cx, intrinsics.cy),
        _FAR,
        wp.array(device_from_stored(pose), dtype=wp.transform, device=device),
    ]
    wp.launch(cast_rays, shape, inputs, [depth, label], device=device)
    return Images(intrinsics, np.asarray(pose, float), to_numpy(depth), to_numpy(label))


@wp.kernel
def cast_rays(
    mesh: wp.uint64,
    face_label: wp.array(dtype=wp.int32),
    focal: wp.vec2,
    centre: wp.vec2,
    far: wp.float32,
    camera: wp.array(dtype=wp.transform),
    # out
    depth_out: wp.array3d(dtype=wp.float32),
    label_out: wp.array3d(dtype=wp.int32),
):
    """One thread per (view, row, column): depth [m] and label of the first face hit; 0 and -1 where there is none.

    Args:
        face_label: label of each face, (F,).
        camera: T_scene_camera, (V,).
        depth_out: [m], (V, rows, columns).
        label_out: (V, rows, columns).
    """
    v, i, j = wp.tid()
    way = wp.vec3((float(j) - centre[0]) / focal[0], (float(i) - centre[1]) / focal[1], 1.0)
    length = wp.length(way)
    T = camera[v]
    direction = wp.transform_vector(T, way / length)
    hit = wp.mesh_query_ray(mesh, wp.transform_get_translation(T), direction, far * length)
    if hit.result:
        depth_out[v, i, j] = hit.t / length
        label_out[v, i, j] = face_label[hit.face]
    else:
        depth_out[v, i, j] = 0.0
        label_out[v, i, j] = -1
