"""Pictures of a hand without a display: contact patches, canonical box, palmar side, workspace, sample grasps."""

from collections.abc import Callable, Iterable
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
from lgrasp.jobs.hand_check.plotting import add_box, add_view, frame_points, new_figure, save_figure, shade
from lgrasp.refine.params import DISTAL, OTHER

_COLOURS = ("#d62728", "#1f77b4", "#2ca02c", "#9467bd", "#e377c2", "#17becf")
_PALM = "#e8a400"
_LINK = "#c4c8cc"
_WEIGHT_COLOURS = {DISTAL: "#d62728", OTHER: "#f2b134"}  # palmar points by their weight
_OBJECT = "#ff9a3c"
_MAX_LINK_FACES = 2500  # of a link


def draw_hand(inputs: Inputs, path: Path) -> Path:
    """The open hand from two sides: surface that may touch in colours, the palm's in gold, canonical box."""
    title = "open posture, surface that may touch, canonical box"
    return _draw_sides(inputs, path, title, _patches(inputs.hand.model), [])


def draw_workspace(inputs: Inputs, path: Path) -> Path:
    """Where each finger's contact surface can go (dots), the canonical box and the hand, from two sides."""
    groups = inputs.hand.model.groups
    clouds = [field_vectors(inputs.field.model, g, groups)[0] for g in range(groups)]
    clouds = [c[:: max(1, len(c) // 1500)] for c in clouds]
    return _draw_sides(inputs, path, "reach of every finger's contact surface", lambda *link: [], clouds)


def _draw_sides(inputs: Inputs, path: Path, title: str, paint: "_Paint", clouds: list[np.ndarray]) -> Path:
    """The open hand from two sides with its canonical box and a cloud of dots for each finger."""
    model = inputs.hand.model
    hand, figure, towards = _Hand(inputs, model.tree.joint_open), new_figure(13, 7.2), _palmar_direction(inputs)
    solid = hand.painted(paint)
    for i, turn in enumerate((20.0, 115.0)):
        axes = add_view(figure, 1, 2, i, *solid)
        for g, cloud in enumerate(clouds):
            axes.scatter(*cloud.T, s=5.0, color=_COLOURS[g % len(_COLOURS)], alpha=0.5, linewidths=0, zorder=5)
        add_box(axes, model.canonical_box)
        frame_points(axes, np.vstack([hand.points, model.canonical_box, *clouds]), towards, turn)
    _legend(figure, inputs)
    figure.suptitle(f"{model.name}: {title}")
    return save_figure(figure, path)


def draw_palmar(inputs: Inputs, path: Path) -> Path:
    """The open hand from four sides, its palmar side in colours: what it pulls to an object, by weight."""
    from matplotlib.patches import Patch

    model = inputs.hand.model
    side, last = visible_surface(inputs.keys.source, model, inputs.hand.device), last_bodies(model)

    def paint(samples: SurfaceSamples, mesh: trimesh.Trimesh) -> _Painted:
        own = side.link == model.tree.link_names.index(samples.link)
        if own.any():
            weight = DISTAL if samples.body in last else OTHER
            yield _seen_faces(mesh, samples, side.points[own]), _WEIGHT_COLOURS[weight]

    hand, figure = _Hand(inputs, model.tree.joint_open), new_figure(16, 5.6)
    solid = hand.painted(paint)
    for i, turn in enumerate((0.0, 75.0, 180.0, -75.0)):
        axes = add_view(figure, 1, 4, i, *solid)
        frame_points(axes, hand.points, _palmar_direction(inputs), turn)
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
        hand, obj = _Hand(inputs, shard.grasps.q[row]), shard.objects[0]
        triangles, colours = hand.painted(_patches(model))
        pose = pose_matrix(shard.grasps.object_pose[row, 0])
        mesh = trimesh.Trimesh(np.asarray(obj.vertices), np.asarray(obj.faces), process=False)
        mesh = thin_mesh(mesh, _MAX_LINK_FACES)
        vertices = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        solid = vertices[mesh.faces]
        triangles, colours = np.vstack([triangles, solid]), np.vstack([colours, shade(solid, _OBJECT)])
        axes = add_view(figure, 1, len(samples), i, triangles, colours)
        points = shard.grasps.contact_points[row, 0]
        points = points[np.isfinite(points).all(1)] @ pose[:3, :3].T + pose[:3, 3]
        axes.scatter(*points.T, s=45, c="black", depthshade=False, zorder=10)
        frame_points(axes, np.vstack([hand.points, vertices]), _away(points, vertices.mean(0), inputs), 0.0)
        axes.set_title(f"{name}: {len(points)} contacts, epsilon {shard.grasps.metrics['epsilon'][row]:.2f}")
    figure.suptitle(f"{model.name}: sample grasps (black: contacts)")
    return save_figure(figure, path)


def draw_spaces(inputs: Inputs, names: list[str], path: Path) -> Path:
    """The open hand once for each opposition space, its two sides in colours."""
    source, model = inputs.keys.source, inputs.hand.model
    urdf, hand = read_urdf(source.urdf), _Hand(inputs, model.tree.joint_open)
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    figure = new_figure(3.6 * columns, 4.0 * rows + 0.6)
    towards = _palmar_direction(inputs)
    for i, name in enumerate(names):
        sides = space_sides(urdf, source.spec, model.tree, name, inputs.hand.device)
        coloured = [(link, colour) for side, colour in zip(sides, _COLOURS, strict=False) for link in side]
        solid = hand.painted(
            lambda samples, mesh, coloured=coloured: [
                (_near_faces(mesh, link.points, link.normals), colour)
                for link, colour in coloured
                if link.link == samples.link
            ]
        )
        axes = add_view(figure, rows, columns, i, *solid)
        frame_points(axes, hand.points, towards, 35.0)
        axes.set_title(name)
    figure.suptitle(f"{model.name}: opposition spaces, one side red, the other blue")
    return save_figure(figure, path)


_Painted = Iterable[tuple[np.ndarray, str]]  # faces and their colour
_Paint = Callable[[SurfaceSamples, trimesh.Trimesh], _Painted]  # of a link's mesh


class _Hand:
    """A hand in a posture: its links in about even triangles, and the points that a picture must show of it."""

    def __init__(self, inputs: Inputs, q: np.ndarray) -> None:
        model = inputs.hand.model
        postures = sample_bodies(model, np.asarray(q, float)[None], inputs.hand.device)
        # contact points and body origins: all but an arm
        self.points = np.vstack([postures.place(0, model.contact_body, model.contact_points), postures.t[0][1:]])
        self._meshes: list[tuple[SurfaceSamples, trimesh.Trimesh, np.ndarray]] = []
        for samples in link_surfaces(read_urdf(inputs.keys.source.urdf), model):
            mesh = thin_mesh(samples.mesh, _MAX_LINK_FACES)
            if len(mesh.faces) < _MAX_LINK_FACES:
                edge = max(0.008, float(np.sqrt(4 * mesh.area / _MAX_LINK_FACES)))
                fine = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, edge)[:2]
                mesh = trimesh.Trimesh(*fine, process=False)
            placed = mesh.vertices @ postures.R[0, samples.body].T + postures.t[0, samples.body]
            self._meshes.append((samples, mesh, placed[mesh.faces]))

    def painted(self, paint: _Paint) -> tuple[np.ndarray, np.ndarray]:
        """Triangles (n, 3, 3) [m] in the base frame and their colours (n, 4)."""
        tints = []
        for samples, mesh, placed in self._meshes:
            tints.append(shade(placed, _LINK))
            for faces, colour in paint(samples, mesh):
                tints[-1][faces] = shade(placed[faces], colour)
        return np.concatenate([placed for _, _, placed in self._meshes]), np.concatenate(tints)


def _patches(model: HandModel) -> _Paint:
    """Surface that may touch, in the colour of its finger."""

    def paint(samples: SurfaceSamples, mesh: trimesh.Trimesh) -> _Painted:
        rows = np.flatnonzero(model.contact_link == model.tree.link_names.index(samples.link))
        if len(rows):
            group = int(np.searchsorted(model.contact_first, rows[0], "right")) - 1
            colour = _PALM if group == model.groups else _COLOURS[group % len(_COLOURS)]
            yield _near_faces(mesh, model.contact_points[rows], model.contact_normals[rows]), colour

    return paint


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
    weight = np.where(model.contact_body == 0, 2.0, 1.0)
    n = postures.turn(0, model.contact_body, model.contact_normals)
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


def _legend(figure: Any, inputs: Inputs) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    model = inputs.hand.model
    names = dict(inputs.keys.source.spec.fingers)
    marks: list[Any] = [
        Patch(color=_COLOURS[g % len(_COLOURS)], label=finger_label(model, names, g)) for g in range(model.groups)
    ]
    if model.contact_first[-1] > model.contact_first[-2]:
        marks.append(Patch(color=_PALM, label="palm"))
    marks.append(Line2D([], [], color="black", label="canonical box"))
    figure.legend(handles=marks, loc="lower center", ncols=len(marks), fontsize=9, frameon=False)
