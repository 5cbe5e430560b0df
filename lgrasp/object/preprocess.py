"""Mesh -> ObjectModel."""

import os

import numpy as np
import trimesh

from lgrasp.geometry.clusters import bounding_spheres, cluster_order
from lgrasp.geometry.edges import face_normals, sample_creases
from lgrasp.object.load import load_mesh
from lgrasp.object.mass import mass_properties
from lgrasp.object.model import ObjectModel
from lgrasp.object.params import ObjectParams
from lgrasp.object.sdf import SdfGrid, build_sdf
from lgrasp.object.surface import fold_cosine, opposite_points, probe_fits, sample_surface, thin
from lgrasp.runtime.device import start

_RELAXED_ANGLES = (25.0, 35.0)  # [deg] tried when the sharpness mask leaves too few contact points


def preprocess_object(
    path_or_mesh: str | os.PathLike[str] | trimesh.Trimesh,
    *,
    scale: float = 1.0,
    params: ObjectParams | None = None,
) -> ObjectModel:
    """Mesh to ObjectModel; the same input gives the same bytes on one kind of CPU.

    Args:
        scale: Factor from the file's unit to metres.

    Raises:
        ObjectError: The mesh cannot be used; the message names the file, the value and what is accepted.
    """
    start()
    params = params or ObjectParams()
    mesh = load_mesh(path_or_mesh, scale=scale, params=params)
    notes = list(mesh.notes)
    center = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    vertices, faces = mesh.vertices - center, mesh.faces
    sdf = build_sdf(
        vertices,
        faces,
        closed=mesh.closed,
        max_cells=params.sdf_cells,
        min_cell=params.sdf_min_cell,
        pad=params.sdf_pad,
    )
    if not (sdf.values < 0.0).any():
        notes.append(f"no SDF cell lies inside: walls are thinner than {sdf.cell * 1000.0:.2g} mm or enclose nothing")
    contact_points, contact_normals = _contacts(vertices, faces, sdf, params, notes)
    obstacle_points, obstacle_normals = _obstacles(vertices, faces, params)
    cluster_center, cluster_radius = bounding_spheres(obstacle_points)
    return ObjectModel(
        name=mesh.name,
        sha256=mesh.sha256,
        scale=float(scale),
        center=center.astype(np.float32),
        vertices=mesh.vertices.astype(np.float32),
        faces=faces,
        watertight=mesh.closed,
        com=mass_properties(vertices, faces).center.astype(np.float32),
        extents=np.ptp(vertices, axis=0).astype(np.float32),
        notes=notes,
        contact_points=contact_points,
        contact_normals=contact_normals,
        contact_opposite=opposite_points(contact_points, contact_normals, seed=params.seed),
        obstacle_points=obstacle_points,
        obstacle_normals=obstacle_normals,
        cluster_center=cluster_center,
        cluster_radius=cluster_radius,
        sdf=sdf.values,
        sdf_origin=sdf.origin,
        sdf_cell=sdf.cell,
    )


def _contacts(
    vertices: np.ndarray, faces: np.ndarray, sdf: SdfGrid, params: ObjectParams, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Contact points and normals, f32, that are neither concave nor beside a fold."""
    normals, area = face_normals(vertices, faces)
    points, face = sample_surface(vertices, faces, params.contact_count, seed=params.seed)
    keep = thin(points, params.contact_count, float(area.sum()))
    points, face = points[keep], face[keep]
    least = max(1, int(params.min_contact_fraction * params.contact_count))
    probe = probe_fits(sdf, points, normals[face], params.probe_radius, params.probe_tolerance)
    cosine = fold_cosine(vertices, faces, points, face, params.sharp_radius)
    chosen = probe & (cosine >= np.cos(np.radians(params.sharp_angle)))
    for angle in (a for a in _RELAXED_ANGLES if a > params.sharp_angle):
        if chosen.sum() < least:
            chosen = probe & (cosine >= np.cos(np.radians(angle)))
            notes.append(f"few smooth contact points: turns of {angle:g} deg within the fold reach were admitted")
    if chosen.sum() < least and probe.any():
        chosen = probe
        notes.append("few smooth contact points: the fold test was left out")
    if not chosen.any():
        chosen = np.ones_like(probe)
        notes.append("no contact point lets a finger-sized ball rest: the concavity test was left out")
    points, face = points[chosen], face[chosen]
    order = cluster_order(points)
    return points[order].astype(np.float32), normals[face[order]].astype(np.float32)


def _obstacles(vertices: np.ndarray, faces: np.ndarray, params: ObjectParams) -> tuple[np.ndarray, np.ndarray]:
    """Obstacle points and normals, f32, creases first among the candidates, in cluster order."""
    normals, area = face_normals(vertices, faces)
    points, face = sample_surface(vertices, faces, params.obstacle_count, seed=params.seed + 1)
    total = float(area.sum())
    spacing = 0.9 * float(np.sqrt(total / params.obstacle_count))
    edge_points, edge_normals = sample_creases(vertices, faces, params.crease_angle, spacing)
    points = np.concatenate([edge_points, points])
    normals = np.concatenate([edge_normals, normals[face]])
    keep = thin(points, params.obstacle_count, total)
    keep = keep[cluster_order(points[keep])]
    return points[keep].astype(np.float32), normals[keep].astype(np.float32)
