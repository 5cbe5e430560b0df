"""Pictures of a hand without a display: contact patches, canonical box, palmar side, workspace, sample grasps."""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from lgrasp.engine.inputs import Inputs
from lgrasp.geometry.poses import pose_matrix
from lgrasp.grasp.records import Shard
from lgrasp.hand.geometry import thin_mesh
from lgrasp.hand.model import HandModel
from lgrasp.hand.opposition.spaces import space_sides
from lgrasp.hand.postures import sample_bodies
from lgrasp.hand.surface import SurfaceSamples
from lgrasp.hand.surface_visibility import last_bodies, link_surfaces, visible_surface
from lgrasp.hand.urdf import read_urdf
from lgrasp.jobs.hand_check.diagnose import field_vectors, finger_label
from lgrasp.jobs.hand_check.plotting import add_box, add_triangles, frame_points, new_figure, save_figure, shade
from lgrasp.refine.surface import DISTAL, OTHER

_COLOURS = ("#d62728", "#1f77b4", "#2ca02c", "#9467bd", "#e377c2", "#17becf")
_PALM = "#e8a400"
_LINK = "#c4c8cc"
_WEIGHT_COLOURS = {DISTAL: "#d62728", OTHER: "#f2b134"}  # palmar points by their weight
_OBJECT = "#ff9a3c"
_MAX_LINK_FACES = 2500  # of a link


def draw_hand(inputs: Inputs, path: Path) -> Path:
    """The open hand from two sides: surface that may touch in colours, the palm's in gold, canonical box."""
    model = inputs.hand.model
    triangles, colours = _hand_triangles(inputs, model.tree.joint_open, patches=True)
    figure = new_figure(13, 7.2)
    towards = _palmar_direction(inputs)
    for i, turn in enumerate((20.0, 115.0)):
        axes = figure.add_subplot(1, 2, i + 1, projection="3d")
        add_triangles(axes, triangles, colours)
        add_box(axes, model.canonical_box)
        frame_points(axes, np.vstack([_hand_points(inputs, model.tree.joint_open), model.canonical_box]), towards, turn)
    _legend(figure, inputs, box=True)
    figure.suptitle(f"{model.name}: open posture, surface that may touch, canonical box")
    return save_figure(figure, path)


def draw_workspace(inputs: Inputs, path: Path) -> Path:
    """Where each finger's contact surface can go (dots), the canonical box and the hand, from two sides."""
    model = inputs.hand.model
    triangles, colours = _hand_triangles(inputs, model.tree.joint_open, patches=False)
    clouds = [field_vectors(inputs.field.model, g, model.groups)[0] for g in range(model.groups)]
    clouds = [c[:: max(1, len(c) // 1500)] for c in clouds]
    figure = new_figure(13, 7.2)
    towards = _palmar_direction(inputs)
    for i, turn in enumerate((20.0, 115.0)):
        axes = figure.add_subplot(1, 2, i + 1, projection="3d")
        add_triangles(axes, triangles, colours)
        for g, cloud in enumerate(clouds):
            axes.scatter(*cloud.T, s=5.0, color=_COLOURS[g % len(_COLOURS)], alpha=0.5, linewidths=0, zorder=5)
        add_box(axes, model.canonical_box)
        frame_points(
            axes, np.vstack([_hand_points(inputs, model.tree.joint_open), model.canonical_box, *clouds]), towards, turn
        )
    _legend(figure, inputs, box=True)
    figure.suptitle(f"{model.name}: reach of every finger's contact surface")
    return save_figure(figure, path)


def draw_palmar(inputs: Inputs, path: Path) -> Path:
    """The open hand from four sides, its palmar side in colours: what it pulls to an object, by weight."""
    from matplotlib.patches import Patch

    source, model = inputs.keys.source, inputs.hand.model
    q, last = model.tree.joint_open, last_bodies(model)
    side = visible_surface(source, model, inputs.hand.device)
    triangles, colours = [], []
    for samples, mesh, placed in _hand_meshes(inputs, q):
        own, tint = side.link == model.tree.link_names.index(samples.link), shade(placed, _LINK)
        if own.any():
            pulled = _seen_faces(mesh, samples, side.points[own])
            tint[pulled] = shade(placed[pulled], _WEIGHT_COLOURS[DISTAL if samples.body in last else OTHER])
        triangles.append(placed)
        colours.append(tint)
    figure = new_figure(16, 5.6)
    for i, turn in enumerate((0.0, 75.0, 180.0, -75.0)):
        axes = figure.add_subplot(1, 4, i + 1, projection="3d")
        add_triangles(axes, np.concatenate(triangles), np.concatenate(colours))
        frame_points(axes, _hand_points(inputs, q), _palmar_direction(inputs), turn)
    words = {DISTAL: "last links", OTHER: "other links"}
    marks = [Patch(color=colour, label=f"{words[w]}, weight {w:g}") for w, colour in _WEIGHT_COLOURS.items()]
    figure.legend(handles=[*marks, Patch(color=_LINK, label="not palmar")], loc="lower center", ncols=3, frameon=False)
    figure.suptitle(f"{model.name}: palmar side, from the front, both sides and the back")
    return save_figure(figure, path)


def draw_grasps(inputs: Inputs, samples: list[tuple[str, Shard, int]], path: Path) -> Path:
    """Sample grasps with their objects and contact points."""
    model = inputs.hand.model
    figure = new_figure(15, 6.0)
    for i, (name, shard, row) in enumerate(samples):
        axes = figure.add_subplot(1, len(samples), i + 1, projection="3d")
        triangles, colours = _hand_triangles(inputs, shard.grasps.q[row], patches=True)
        obj = shard.objects[0]
        pose = pose_matrix(shard.grasps.object_pose[row, 0])
        mesh = thin_mesh(
            trimesh.Trimesh(np.asarray(obj.vertices), np.asarray(obj.faces), process=False), _MAX_LINK_FACES
        )
        vertices = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        solid = vertices[mesh.faces]
        add_triangles(axes, np.vstack([triangles, solid]), np.vstack([colours, shade(solid, _OBJECT)]))
        points = shard.grasps.contact_points[row, 0]
        points = points[np.isfinite(points).all(1)] @ pose[:3, :3].T + pose[:3, 3]
        axes.scatter(*points.T, s=45, c="black", depthshade=False, zorder=10)
        frame_points(
            axes,
            np.vstack([_hand_points(inputs, shard.grasps.q[row]), vertices]),
            _away(points, vertices.mean(0), inputs),
            0.0,
        )
        axes.set_title(f"{name}: {len(points)} contacts, epsilon {shard.grasps.metrics['epsilon'][row]:.2f}")
    figure.suptitle(f"{model.name}: sample grasps (black: contacts)")
    return save_figure(figure, path)


def draw_spaces(inputs: Inputs, names: list[str], path: Path) -> Path:
    """The open hand once for each opposition space, its two sides in colours."""
    source, model = inputs.keys.source, inputs.hand.model
    urdf, q = read_urdf(source.urdf), model.tree.joint_open
    meshes = _hand_meshes(inputs, q)
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    figure = new_figure(3.6 * columns, 4.0 * rows + 0.6)
    towards = _palmar_direction(inputs)
    for i, name in enumerate(names):
        tints = [shade(placed, _LINK) for _, _, placed in meshes]
        for side, colour in zip(
            space_sides(urdf, source.spec, model.tree, name, inputs.hand.device), _COLOURS, strict=False
        ):
            for link in side.links:
                for (samples, mesh, placed), tint in zip(meshes, tints, strict=True):
                    if samples.link == link.link:
                        near = _near_faces(mesh, link.points, link.normals)
                        tint[near] = shade(placed[near], colour)
        axes = figure.add_subplot(rows, columns, i + 1, projection="3d")
        add_triangles(axes, np.concatenate([placed for _, _, placed in meshes]), np.concatenate(tints))
        frame_points(axes, _hand_points(inputs, q), towards, 35.0)
        axes.set_title(name)
    figure.suptitle(f"{model.name}: opposition spaces, one side red, the other blue")
    return save_figure(figure, path)


def _hand_triangles(inputs: Inputs, q: np.ndarray, *, patches: bool) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (n, 3, 3) of a hand in the base frame and their colours (n, 4)."""
    model = inputs.hand.model
    triangles, colours = [], []
    for samples, mesh, placed in _hand_meshes(inputs, q):
        tint = shade(placed, _LINK)
        if patches:
            for group, chosen in _patch_faces(model, samples, mesh):
                colour = _PALM if group == model.groups else _COLOURS[group % len(_COLOURS)]
                tint[chosen] = shade(placed[chosen], colour)
        triangles.append(placed)
        colours.append(tint)
    return np.concatenate(triangles), np.concatenate(colours)


def _hand_meshes(inputs: Inputs, q: np.ndarray) -> list[tuple[SurfaceSamples, trimesh.Trimesh, np.ndarray]]:
    """Every link with its mesh (body frame) in about even triangles, and these (n, 3, 3) in the base frame."""
    model = inputs.hand.model
    postures = sample_bodies(model, np.asarray(q, float)[None], inputs.hand.device)
    R, t = postures.R[0], postures.t[0]
    out = []
    for samples in link_surfaces(read_urdf(inputs.keys.source.urdf), model):
        mesh = thin_mesh(samples.mesh, _MAX_LINK_FACES)
        if len(mesh.faces) < _MAX_LINK_FACES:
            edge = max(0.008, float(np.sqrt(4 * mesh.area / _MAX_LINK_FACES)))
            mesh = trimesh.Trimesh(
                *trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, edge)[:2], process=False
            )
        out.append((samples, mesh, (mesh.vertices @ R[samples.body].T + t[samples.body])[mesh.faces]))
    return out


def _hand_points(inputs: Inputs, q: np.ndarray) -> np.ndarray:
    """Contact points (n, 3) and body origins at a posture: what a picture must show of a hand, without its arm."""
    model = inputs.hand.model
    postures = sample_bodies(model, np.asarray(q, float)[None], inputs.hand.device)
    body = model.contact_body
    placed = np.einsum("nij,nj->ni", postures.R[0][body], model.contact_points) + postures.t[0][body]
    return np.vstack([placed, postures.t[0][1:]])


def _patch_faces(model: HandModel, samples: SurfaceSamples, mesh: trimesh.Trimesh) -> list[tuple[int, np.ndarray]]:
    """(group, faces that are contact surface) of a link."""
    link = model.tree.link_names.index(samples.link)
    rows = np.flatnonzero(model.contact_link == link)
    if not len(rows):
        return []
    group = int(np.searchsorted(model.contact_first, rows[0], "right")) - 1
    return [(group, _near_faces(mesh, model.contact_points[rows], model.contact_normals[rows]))]


def _near_faces(mesh: trimesh.Trimesh, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Faces of a mesh that lie at contact points (n, 3) and look their way."""
    far, near = cKDTree(points).query(mesh.triangles_center)
    return np.flatnonzero((far < 0.006) & ((mesh.face_normals * normals[near]).sum(1) > 0.6))


def _seen_faces(mesh: trimesh.Trimesh, samples: SurfaceSamples, palmar: np.ndarray) -> np.ndarray:
    """Faces of a mesh whose nearest sample of the samples that looks their way is one of the palmar ones (n, 3)."""
    seen = cKDTree(palmar).query(samples.points)[0] < 1e-9
    near = cKDTree(samples.points).query(mesh.triangles_center, 8)[1]  # (m, 8)
    alike = np.einsum("mki,mi->mk", samples.normals[near], mesh.face_normals) > 0.6
    chosen = near[np.arange(len(near)), alike.argmax(1)]
    return np.flatnonzero(seen[chosen] & alike.any(1))


def _palmar_direction(inputs: Inputs) -> np.ndarray:
    """Direction from which the contact surface of the open hand is seen best."""
    model = inputs.hand.model
    postures = sample_bodies(model, model.tree.joint_open[None], inputs.hand.device)
    last = int(model.contact_first[model.groups + 1])
    body = model.contact_body[:last]
    weight = np.where(body == 0, 2.0, 1.0)
    n = np.einsum("nij,nj->ni", postures.R[0][body], model.contact_normals[:last])
    way = (weight[:, None] * n).sum(0)
    size = float(np.linalg.norm(way))
    if size < 0.15 * weight.sum():  # jaws that face each other: look across them
        return np.linalg.svd(n - n.mean(0), full_matrices=False)[2][-1]
    return way / size


def _away(points: np.ndarray, centre: np.ndarray, inputs: Inputs) -> np.ndarray:
    """A direction from which object and contacts are seen past the hand."""
    way = centre - points.mean(0) + 0.02 * _palmar_direction(inputs)
    size = float(np.linalg.norm(way))
    return way / size if size > 1e-6 else _palmar_direction(inputs)


def _legend(figure: Any, inputs: Inputs, *, box: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    model = inputs.hand.model
    names = dict(inputs.keys.source.spec.fingers)
    marks: list[Any] = [
        Patch(color=_COLOURS[g % len(_COLOURS)], label=finger_label(model, names, g)) for g in range(model.groups)
    ]
    if model.contact_first[-1] > model.contact_first[-2]:
        marks.append(Patch(color=_PALM, label="palm"))
    if box:
        marks.append(Line2D([], [], color="black", label="canonical box"))
    figure.legend(handles=marks, loc="lower center", ncols=len(marks), fontsize=9, frameon=False)
