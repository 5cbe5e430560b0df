"""Signed distances of points to a triangle mesh."""

import numpy as np
import trimesh
import warp as wp

from lgrasp.hand.mesh_kernels import mesh_distance, winding_distance
from lgrasp.runtime.device import start


def signed_distance(
    mesh: trimesh.Trimesh, points: np.ndarray, device: str = "cpu", *, winding: bool = False
) -> np.ndarray:
    """Signed distances (n,) [m] of points (n, 3) to a mesh, negative inside.

    Args:
        winding: decide inside and outside by winding numbers, which bear holes and cost more.
    """
    start()
    handle = wp.Mesh(
        wp.array(np.asarray(mesh.vertices, np.float32), dtype=wp.vec3, device=device),
        wp.array(np.asarray(mesh.faces, np.int32).ravel(), dtype=wp.int32, device=device),
        support_winding_number=winding,
    )
    out = wp.empty(len(points), dtype=wp.float32, device=device)
    queries = wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device=device)
    kernel = winding_distance if winding else mesh_distance
    wp.launch(kernel, dim=len(points), inputs=[handle.id, queries], outputs=[out], device=device)
    return out.numpy()
