"""The gripper weighting map: surface of a hand visible from the mean fingertip, by rays, over many postures."""

from dataclasses import replace

import numpy as np
import trimesh
import warp as wp

from lgrasp.geometry.union import joined_mesh
from lgrasp.hand.contact_surface import ContactSurface
from lgrasp.hand.find import HandSource
from lgrasp.hand.geometry import link_meshes
from lgrasp.hand.model import HandModel
from lgrasp.hand.postures import Postures, sample_bodies
from lgrasp.hand.surface import SurfaceSamples
from lgrasp.hand.urdf import Urdf, read_urdf
from lgrasp.runtime.device import KERNEL_OPTIONS, start
from lgrasp.runtime.fetch import to_numpy

wp.set_module_options(KERNEL_OPTIONS)

_POINTS_PER_LINK = 400
_VIEWED_POSTURES = 32  # of those given
_SAMPLED_POSTURES = 64
_MIN_SEEN_SHARE = 0.3  # of postures


def link_surfaces(urdf: Urdf, model: HandModel) -> list[SurfaceSamples]:
    """Surface samples of every link with collision geometry; nothing is seen yet."""
    surfaces = []
    tree = model.tree
    for index, link in enumerate(tree.link_names):
        if urdf.links[link]:
            mesh = joined_mesh(link_meshes(urdf, tree, link))
            points, faces = trimesh.sample.sample_surface(mesh, _POINTS_PER_LINK, seed=index)[:2]
            normals, seen = np.asarray(mesh.face_normals)[faces], np.zeros(len(points))
            T, body = tree.T_body_link[index], int(tree.link_body[index])
            surfaces.append(SurfaceSamples(link, body, float(mesh.area), points, normals, seen, T, mesh))
    return surfaces


def surface_visibility(
    surfaces: list[SurfaceSamples], postures: Postures, tips: dict[int, np.ndarray]
) -> list[SurfaceSamples]:
    """The surfaces with the share of postures at which the mean fingertip sees each point.

    Args:
        tips: tip body -> fingertip in its body frame [m].
    """
    start()
    whole = joined_mesh([s.mesh for s in surfaces])
    body = np.repeat([s.body for s in surfaces], [len(s.mesh.vertices) for s in surfaces])
    point_body = np.repeat([s.body for s in surfaces], [len(s.points) for s in surfaces])
    points, normals = (np.concatenate([getattr(s, k) for s in surfaces]) for k in ("points", "normals"))
    seen = np.zeros(len(points))
    chosen = np.argsort(postures.touching, kind="stable")[:_VIEWED_POSTURES]  # postures that collide come last
    handle = None
    for row in chosen:
        placed = postures.place(row, body, whole.vertices)
        world = wp.array(placed.astype(np.float32), dtype=wp.vec3, device="cpu")
        if handle is None:
            handle = wp.Mesh(world, wp.array(whole.faces.ravel().astype(np.int32), dtype=wp.int32, device="cpu"))
        else:
            wp.copy(handle.points, world)
            handle.refit()
        eye = np.mean([postures.R[row, b] @ p + postures.t[row, b] for b, p in tips.items()], 0)
        target, out = postures.put(row, point_body, points, normals)
        facing = np.flatnonzero(np.einsum("ni,ni->n", out, eye - target) > 0)
        free = wp.empty(len(facing), dtype=wp.int32, device="cpu")
        targets = wp.array(target[facing].astype(np.float32), dtype=wp.vec3, device="cpu")
        wp.launch(first_hits, len(facing), [handle.id, wp.vec3(*map(float, eye)), targets, 3e-4], [free], device="cpu")
        seen[facing] += to_numpy(free) == 1
    parts = np.split(seen / len(chosen), np.cumsum([len(s.points) for s in surfaces])[:-1])
    return [replace(s, seen=part) for s, part in zip(surfaces, parts, strict=True)]


def visible_surface(source: HandSource, model: HandModel) -> ContactSurface:
    """The palmar side of a hand: what the mean fingertip sees. A ray from there meets it first, in three of ten random
    postures or more."""
    surfaces = link_surfaces(read_urdf(source.urdf), model)
    tips = {b: tip_point([s for s in surfaces if s.body == b], 0.1) for b in last_bodies(model)}
    postures = sample_bodies(model, model.random_postures(_SAMPLED_POSTURES))
    seen = surface_visibility(surfaces, postures, tips)
    chosen = [s.seen >= _MIN_SEEN_SHARE for s in seen]
    link = np.repeat([model.tree.link_names.index(s.link) for s in seen], [int(c.sum()) for c in chosen])
    points, normals = (
        np.concatenate([getattr(s, k)[c] for s, c in zip(seen, chosen, strict=True)]) for k in ("points", "normals")
    )
    return ContactSurface(link, model.tree.link_body[link], points, normals)


def tip_point(surfaces: list[SurfaceSamples], share: float) -> np.ndarray:
    """Middle of the part of a body's surface that is farthest from its joint, (3,) [m].

    Args:
        share: of the points, those that count.
    """
    points = np.concatenate([s.points for s in surfaces])
    far = np.linalg.norm(points, axis=1)
    return points[far >= np.quantile(far, 1 - share)].mean(0)


def last_bodies(model: HandModel) -> set[int]:
    """Bodies with geometry that no body with geometry rides on: the last links of fingers."""
    solid = {int(b) for b in model.piece_body if b > 0}
    return solid - {b for body in solid for b in model.tree.path(body)[:-1]}


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
