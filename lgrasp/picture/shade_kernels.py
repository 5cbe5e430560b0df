"""Kernel of pictures: what a camera sees of shaded meshes, by rays."""

import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class Lighting:
    """Light of a picture, and how it is gathered."""

    towards: wp.vec3  # unit, to the sun
    sun: wp.float32
    shine: wp.float32  # of highlights
    softness: wp.float32  # radius of the sun over its distance
    above: wp.vec3  # light from everywhere above
    below: wp.vec3  # light from everywhere below
    reach: wp.float32  # [m] nearer surface keeps that light away
    samples: wp.int32  # rays through a pixel
    rays: wp.int32  # gathered where one of them meets a surface
    through: wp.float32  # share of a dot that is seen through what hides it


@wp.struct
class PaintedMesh:
    """Triangles with their colours."""

    mesh: wp.uint64
    corner_normal: wp.array(dtype=wp.vec3)  # (3 F,) unit
    colour: wp.array(dtype=wp.vec3)  # (F,)


@wp.struct
class Camera:
    """A pinhole camera."""

    pose: wp.transform  # T_scene_camera
    focal: wp.vec2  # [pixels]
    centre: wp.vec2  # [pixels]


@wp.func
def _normal(s: PaintedMesh, face: wp.int32, u: wp.float32, v: wp.float32):
    n = u * s.corner_normal[3 * face] + v * s.corner_normal[3 * face + 1]
    return wp.normalize(n + (1.0 - u - v) * s.corner_normal[3 * face + 2])


@wp.func
def _fraction(x: wp.float32):
    return x - wp.floor(x)


@wp.func
def _direction(i: wp.int32, j: wp.int32, k: wp.int32):
    """Direction k of a pixel: evenly spread over the sphere, and differently from those of neighbouring pixels."""
    turn = 52.9829189 * _fraction(0.06711056 * float(j) + 0.00583715 * float(i))
    z = 1.0 - 2.0 * _fraction(turn + 0.7548777 * float(k))
    angle = 2.0 * wp.pi * _fraction(7.0 * turn + 0.5698403 * float(k))
    flat = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    return wp.vec3(flat * wp.cos(angle), flat * wp.sin(angle), z)


@wp.func
def _lit(
    s: PaintedMesh, light: Lighting, point: wp.vec3, normal: wp.vec3, look: wp.vec3, colour: wp.vec3, way: wp.vec3
):
    """Light from a point of a surface, seen along ``look``; two rays tell how much of it comes, near ``way``."""
    sky = 0.5 + 0.5 * normal[2]
    around = sky * light.above + (1.0 - sky) * light.below
    near = wp.mesh_query_ray(s.mesh, point, wp.normalize(normal + 0.999 * way), light.reach)
    if near.result:
        far = near.t / light.reach
        around = around * far
    out = wp.cw_mul(colour, around)
    facing = wp.dot(normal, light.towards)
    if facing <= 0.0:
        return out
    if wp.mesh_query_ray_anyhit(s.mesh, point, wp.normalize(light.towards + light.softness * way), 10.0):
        return out
    half = wp.normalize(light.towards - look)
    return out + light.sun * facing * colour + wp.vec3(light.shine * wp.pow(wp.max(wp.dot(half, normal), 0.0), 40.0))


@wp.kernel
def shade(
    solids: PaintedMesh,
    dots: PaintedMesh,
    camera: Camera,
    light: Lighting,
    background: wp.vec3,
    # out
    colour_out: wp.array2d(dtype=wp.vec3),
):
    """One thread per (row, column): linear colour, the mean of ``light.samples`` rays on a turned grid.

    Args:
        colour_out: (rows, columns).
    """
    i, j = wp.tid()
    eye = wp.transform_get_translation(camera.pose)
    total = wp.vec3(0.0)
    share = 1.0 / float(light.samples)
    for k in range(light.samples):
        x = float(j) - 0.5 + share * (float(k) + 0.5) - camera.centre[0]
        y = float(i) - 0.5 + _fraction(share * (float(k) + 0.5) + 0.618034 * float(k)) - camera.centre[1]
        look = wp.normalize(wp.transform_vector(camera.pose, wp.vec3(x / camera.focal[0], y / camera.focal[1], 1.0)))
        seen = background
        hit = wp.mesh_query_ray(solids.mesh, eye, look, 10.0)
        far = float(10.0)
        if hit.result:
            far = hit.t
            normal = _normal(solids, hit.face, hit.u, hit.v)
            flat = hit.normal
            if wp.dot(flat, look) > 0.0:
                flat = -flat
                normal = -normal
            point = eye + hit.t * look + 3.0e-5 * flat
            colour = solids.colour[hit.face]
            seen = wp.vec3(0.0)
            for m in range(light.rays):
                way = _direction(i, j, k * light.rays + m)
                seen = seen + _lit(solids, light, point, normal, look, colour, way) / float(light.rays)
        dot = wp.mesh_query_ray(dots.mesh, eye, look, 10.0)
        if dot.result:
            edge = -wp.dot(_normal(dots, dot.face, dot.u, dot.v), look)
            own = wp.where(edge > 0.5, dots.colour[dot.face], wp.vec3(1.0))
            weight = wp.where(dot.t < far, 1.0, light.through)
            seen = weight * own + (1.0 - weight) * seen
        total = total + seen
    colour_out[i, j] = total * share
