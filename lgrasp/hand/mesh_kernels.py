"""Queries of triangle meshes: signed distances of points, and first hits of rays."""

import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def mesh_distance(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    # out
    distance_out: wp.array(dtype=wp.float32),
):
    """Distances (n,) [m] of points (n,) [m] within 1 m of a mesh, negative inside by the nearest face's normal.

    Args:
        points: [m], (n,).
        distance_out: [m], (n,).
    """
    i = wp.tid()
    q = wp.mesh_query_point_sign_normal(mesh, points[i], 1.0)
    p = wp.mesh_eval_position(mesh, q.face, q.u, q.v)
    distance_out[i] = q.sign * wp.length(points[i] - p)


@wp.kernel
def winding_distance(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    # out
    distance_out: wp.array(dtype=wp.float32),
):
    """As :func:`mesh_distance`, inside and outside by winding numbers, which bear holes.

    Args:
        points: [m], (n,).
        distance_out: [m], (n,).
    """
    i = wp.tid()
    q = wp.mesh_query_point_sign_winding_number(mesh, points[i], 1.0)
    p = wp.mesh_eval_position(mesh, q.face, q.u, q.v)
    distance_out[i] = q.sign * wp.length(points[i] - p)


@wp.kernel
def first_hits(
    mesh: wp.uint64,
    origin: wp.vec3,
    target: wp.array(dtype=wp.vec3),
    slack: wp.float32,
    # out
    free_out: wp.array(dtype=wp.int32),
):
    """Whether the line from the origin to each target is free, except for the last ``slack`` [m].

    Args:
        target: [m], (n,).
        free_out: 1 where it is, (n,).
    """
    i = wp.tid()
    way = target[i] - origin
    length = wp.length(way)
    hit = wp.mesh_query_ray(mesh, origin, way / length, length - slack)
    free_out[i] = wp.where(hit.result, 0, 1)
