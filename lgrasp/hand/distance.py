"""Signed distances of points to a triangle mesh."""

import numpy as np
import trimesh
import warp as wp

from lgrasp.runtime.cores import cores
from lgrasp.runtime.device import KERNEL_OPTIONS, start
from lgrasp.runtime.fetch import to_numpy
from lgrasp.runtime.ordered import in_order

wp.set_module_options(KERNEL_OPTIONS)

_LEAST_POINTS = 2000  # that are worth a thread


@wp.kernel
def mesh_distance(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    winding: wp.bool,
    # out
    distance_out: wp.array(dtype=wp.float32),
):
    """Distances to a mesh within 1 m, negative inside by the nearest face's normal, or by winding numbers.

    Args:
        points: [m], (n,).
        distance_out: [m], (n,).
    """
    i = wp.tid()
    q = wp.mesh_query_point_sign_normal(mesh, points[i], 1.0)
    p = wp.mesh_eval_position(mesh, q.face, q.u, q.v)
    sign = q.sign
    if winding:
        sign = wp.mesh_query_point_sign_winding_number(mesh, points[i], 1.0).sign
    distance_out[i] = sign * wp.length(points[i] - p)


def signed_distance(mesh: trimesh.Trimesh, points: np.ndarray, *, winding: bool = False) -> np.ndarray:
    """Signed distances (n,) [m] of points (n, 3) to a mesh, negative inside.

    Args:
        winding: decide inside and outside by winding numbers, which bear holes and cost more.
    """
    if not len(points):
        return np.zeros(0, np.float32)
    start()
    handle = wp.Mesh(
        wp.array(np.asarray(mesh.vertices, np.float32), dtype=wp.vec3, device="cpu"),
        wp.array(np.asarray(mesh.faces, np.int32).ravel(), dtype=wp.int32, device="cpu"),
        support_winding_number=winding,
    )
    out = wp.empty(len(points), dtype=wp.float32, device="cpu")
    queries = wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device="cpu")
    wp.load_module(__name__, "cpu")  # once, not by every thread

    def measure(rows: slice) -> None:
        inputs = [handle.id, queries[rows], winding]
        wp.launch(mesh_distance, len(queries[rows]), inputs, [out[rows]], device="cpu")

    share = max(_LEAST_POINTS, -(-len(points) // cores()))
    parts = [slice(at, min(at + share, len(points))) for at in range(0, len(points), share)]
    for _ in in_order(measure, parts, len(parts)):
        pass
    return to_numpy(out)
