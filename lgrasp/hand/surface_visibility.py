"""The palmar side of a hand: surface visible from the mean fingertip, by rays, over many postures."""

import numpy as np
import trimesh
import warp as wp

from lgrasp.hand.geometry import geometry_mesh
from lgrasp.hand.mesh_kernels import first_hits
from lgrasp.hand.model import HandModel
from lgrasp.hand.postures import Postures
from lgrasp.hand.surface import SurfaceSamples
from lgrasp.hand.urdf import Urdf
from lgrasp.runtime.device import start

_POINTS_PER_LINK = 400
_VIEWED_POSTURES = 32  # of those given


def link_surfaces(urdf: Urdf, model: HandModel) -> list[SurfaceSamples]:
    """Surface samples of every link with collision geometry; nothing is seen yet."""
    surfaces = []
    tree = model.tree
    for index, link in enumerate(tree.link_names):
        if not urdf.links[link]:
            continue
        meshes = []
        for geometry in urdf.links[link]:
            mesh = geometry_mesh(urdf, geometry)
            meshes.append(mesh.apply_transform(tree.T_body_link[index] @ geometry.T_link_geometry))
        mesh = _join(meshes)
        points, faces = trimesh.sample.sample_surface(mesh, _POINTS_PER_LINK, seed=index)[:2]
        normals = np.asarray(mesh.face_normals)[faces]
        T, body = tree.T_body_link[index], int(tree.link_body[index])
        surfaces.append(SurfaceSamples(link, body, float(mesh.area), points, normals, np.zeros(len(points)), T, mesh))
    return surfaces


def _join(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    joined = trimesh.util.concatenate(meshes)
    assert isinstance(joined, trimesh.Trimesh)
    return joined


def surface_visibility(
    surfaces: list[SurfaceSamples], postures: Postures, tips: dict[int, np.ndarray], device: str = "cpu"
) -> list[SurfaceSamples]:
    """The surfaces with the share of postures at which the mean fingertip sees each point.

    Args:
        tips: tip body -> fingertip in its body frame [m].
    """
    start()
    body = np.concatenate([np.full(len(s.mesh.vertices), s.body) for s in surfaces])
    vertices = np.concatenate([s.mesh.vertices for s in surfaces])
    offsets = np.cumsum([0, *(len(s.mesh.vertices) for s in surfaces)])
    faces = np.concatenate([s.mesh.faces + o for s, o in zip(surfaces, offsets, strict=False)])
    point_body = np.concatenate([np.full(len(s.points), s.body) for s in surfaces])
    points, normals = (np.concatenate([getattr(s, k) for s in surfaces]) for k in ("points", "normals"))
    seen = np.zeros(len(points))
    chosen = np.argsort(postures.touching, kind="stable")[:_VIEWED_POSTURES]  # postures that collide come last
    handle = None
    for row in chosen:
        R, t = postures.R[row], postures.t[row]

        def place(p: np.ndarray, b: np.ndarray, R: np.ndarray = R, t: np.ndarray = t) -> np.ndarray:
            return np.einsum("nij,nj->ni", R[b], p) + t[b]

        world = wp.array(place(vertices, body).astype(np.float32), dtype=wp.vec3, device=device)
        if handle is None:
            handle = wp.Mesh(world, wp.array(faces.ravel().astype(np.int32), dtype=wp.int32, device=device))
        else:
            wp.copy(handle.points, world)
            handle.refit()
        eye = np.mean([R[b] @ p + t[b] for b, p in tips.items()], 0)
        target = place(points, point_body)
        facing = np.einsum("ni,ni->n", np.einsum("nij,nj->ni", R[point_body], normals), eye - target) > 0
        free = wp.empty(len(target), dtype=wp.int32, device=device)
        targets = wp.array(target.astype(np.float32), dtype=wp.vec3, device=device)
        wp.launch(first_hits, len(target), [handle.id, wp.vec3(*map(float, eye)), targets, 3e-4], [free], device=device)
        seen += facing & (free.numpy() == 1)
    parts = np.split(seen / len(chosen), np.cumsum([len(s.points) for s in surfaces])[:-1])
    return [
        SurfaceSamples(s.link, s.body, s.area, s.points, s.normals, part, s.T_body_link, s.mesh)
        for s, part in zip(surfaces, parts, strict=True)
    ]
