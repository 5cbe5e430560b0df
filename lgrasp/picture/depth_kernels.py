"""Kernel of the depth camera: rays against a mesh."""

import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


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
