"""Pictures of an open hand: surface that may touch, canonical box, palmar side, workspace, opposition spaces."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from lgrasp.engine.inputs import Inputs
from lgrasp.files import write_file
from lgrasp.geometry.union import joined_mesh
from lgrasp.hand.fingers import finger_label
from lgrasp.hand.geometry import thin_mesh
from lgrasp.hand.model import HandModel
from lgrasp.hand.opposition.spaces import space_sides
from lgrasp.hand.postures import sample_bodies
from lgrasp.hand.surface import SurfaceSamples
from lgrasp.hand.surface_visibility import last_bodies, link_surfaces, visible_surface
from lgrasp.hand.urdf import read_urdf
from lgrasp.jobs.hand_check.diagnose import field_vectors
from lgrasp.picture.camera import central_camera
from lgrasp.picture.draw import ANGLE, Painted, Viewpoint, draw, framing
from lgrasp.picture.scene import balls
from lgrasp.picture.sheet import image_bytes, sheet
from lgrasp.refine.params import DISTAL, OTHER

_COLOURS = ("#d62728", "#1f77b4", "#2ca02c", "#9467bd", "#e377c2", "#17becf")
_PALM = "#e8a400"
_LINK = "#c4c8cc"
_BOX = "#202020"
_WEIGHT_COLOURS = {DISTAL: "#d62728", OTHER: "#f2b134"}  # palmar points by their weight
_MAX_LINK_FACES = 2500  # of a link
_MAX_DOTS = 800  # of a finger's reach
_DOT, _EDGE = 0.0012, 0.0007  # [m] radius of a dot, and of an edge of the canonical box
_ELEVATIONS, _RISE = (-60.0, 55.0), 12.0  # [deg]
_AROUND = 0.04  # [m] so close to contact surface and joints links are in the picture

_Key = Sequence[tuple[str, str]]  # words and their colour
_Faces = Iterable[tuple[np.ndarray, str]]  # faces and their colour
_Paint = Callable[[SurfaceSamples, trimesh.Trimesh], _Faces]  # of a link's mesh


def draw_hand(inputs: Inputs, path: Path) -> Path:
    """The open hand from two sides: surface that may touch in colours, the palm's in gold, canonical box."""
    return _draw_sides(inputs, path, _patches(inputs.hand.model), [])


def draw_workspace(inputs: Inputs, path: Path) -> Path:
    """Where each finger's contact surface can go (dots), the canonical box and the hand, from two sides."""
    groups = inputs.hand.model.groups
    clouds = [field_vectors(inputs.field.model, g, groups)[0] for g in range(groups)]
    return _draw_sides(inputs, path, lambda *link: [], [c[:: max(1, len(c) // _MAX_DOTS)] for c in clouds])


def _draw_sides(inputs: Inputs, path: Path, paint: _Paint, clouds: list[np.ndarray]) -> Path:
    """The open hand from two sides with its canonical box and a cloud of dots for each finger."""
    model, hand = inputs.hand.model, _Hand(inputs)
    names = dict(inputs.keys.source.spec.fingers)
    key = [(finger_label(model.tree, names, g), _COLOURS[g % len(_COLOURS)]) for g in range(model.groups)]
    dots = [Painted(balls(c, _DOT, 0), colour) for c, (_, colour) in zip(clouds, key, strict=False) if len(c)]
    if model.contact_first[-1] > model.contact_first[-2]:
        key.append(("palm", _PALM))
    box = trimesh.creation.box(bounds=model.canonical_box)
    edges = box.vertices[np.unique(np.concatenate(box.facets_boundary), axis=0)]  # (12, 2, 3)
    frame = joined_mesh([trimesh.creation.cylinder(_EDGE, segment=ends, sections=8) for ends in edges])
    painted = [*hand.painted(paint), *dots, Painted(frame, _BOX)]
    points = np.vstack([hand.points, model.canonical_box, *clouds])
    sides = [(painted, _view(points, hand.towards, turn, 640)) for turn in (20.0, 115.0)]
    return _write(path, sides, key=[*key, ("canonical box", _BOX)])


def draw_palmar(inputs: Inputs, path: Path) -> Path:
    """The open hand from four sides, its palmar side in colours: what it pulls to an object, by weight."""
    model = inputs.hand.model
    side, last = visible_surface(inputs.keys.source, model), last_bodies(model)

    def paint(samples: SurfaceSamples, mesh: trimesh.Trimesh) -> _Faces:
        own = side.link == model.tree.link_names.index(samples.link)
        if own.any():
            weight = DISTAL if samples.body in last else OTHER
            yield _seen_faces(mesh, samples, side.points[own]), _WEIGHT_COLOURS[weight]

    hand = _Hand(inputs)
    painted, way = hand.painted(paint), hand.towards
    ways = {"front": (way, 0.0), "one side": (way, 75.0), "back": (-way, 0.0), "other side": (way, -75.0)}
    words = {DISTAL: "last links", OTHER: "other links"}
    key = [(f"{words[weight]}, weight {weight:g}", colour) for weight, colour in _WEIGHT_COLOURS.items()]
    sides = [(painted, _view(hand.points, *way, 400)) for way in ways.values()]
    return _write(path, sides, list(ways), 4, [*key, ("not palmar", _LINK)])


def draw_spaces(inputs: Inputs, names: list[str], path: Path) -> Path:
    """The open hand once for each opposition space, its two sides in colours."""
    source, model, hand = inputs.keys.source, inputs.hand.model, _Hand(inputs)
    urdf, view, pictures = read_urdf(source.urdf), _view(hand.points, hand.towards, 35.0, 360), []
    for name in names:
        sides = space_sides(urdf, source.spec, model.tree, name)
        coloured = [(part, colour) for side, colour in zip(sides, _COLOURS, strict=False) for part in side]

        def paint(samples: SurfaceSamples, mesh: trimesh.Trimesh, coloured: list = coloured) -> _Faces:
            for part, colour in coloured:
                if part.link == samples.link:
                    yield _near_faces(mesh, part.points, part.normals), colour

        pictures.append((hand.painted(paint), view))
    return _write(path, pictures, names, min(4, len(names)), [("one side", _COLOURS[0]), ("the other", _COLOURS[1])])


class _Hand:
    """The open hand: its links in about even triangles, and the points that a picture must show of it."""

    def __init__(self, inputs: Inputs) -> None:
        model = inputs.hand.model
        postures = sample_bodies(model, model.tree.joint_open[None])
        # links around contact points and body origins: all but an arm
        points = np.vstack([postures.place(0, model.contact_body, model.contact_points), postures.t[0][1:]])
        self.towards = _palmar_direction(model, postures.turn(0, model.contact_body, model.contact_normals))
        self._links: list[tuple[SurfaceSamples, trimesh.Trimesh, trimesh.Trimesh]] = []
        for samples in link_surfaces(read_urdf(inputs.keys.source.urdf), model):
            mesh = thin_mesh(samples.mesh, _MAX_LINK_FACES)
            if len(mesh.faces) < _MAX_LINK_FACES:
                edge = max(0.008, float(np.sqrt(4 * mesh.area / _MAX_LINK_FACES)))
                fine = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, edge)[:2]
                mesh = trimesh.Trimesh(*fine, process=False)
            placed = mesh.vertices @ postures.R[0, samples.body].T + postures.t[0, samples.body]
            self._links.append((samples, mesh, trimesh.Trimesh(placed, mesh.faces, process=False)))
        corners = np.concatenate([placed.vertices for _, _, placed in self._links])
        near = (corners > points.min(0) - _AROUND) & (corners < points.max(0) + _AROUND)
        self.points = corners[near.all(1)]

    def painted(self, paint: _Paint) -> list[Painted]:
        """The links in the base frame."""
        found = []
        for samples, mesh, placed in self._links:
            colours = np.full(len(mesh.faces), _LINK)
            for faces, colour in paint(samples, mesh):
                colours[faces] = colour
            found.append(Painted(placed, colours.tolist()))
        return found


def _view(points: np.ndarray, towards: np.ndarray, turn: float, size: int) -> Viewpoint:
    """A camera on the side ``towards`` of points (n, 3), turned about z by ``turn`` degrees, that sees all of them."""
    rise = np.radians(np.clip(np.degrees(np.arcsin(np.clip(towards[2], -1, 1))), *_ELEVATIONS) + _RISE)
    turned = np.arctan2(towards[1], towards[0]) + np.radians(turn)
    way = np.array([np.cos(turned) * np.cos(rise), np.sin(turned) * np.cos(rise), np.sin(rise)])
    return Viewpoint(central_camera(size, size, ANGLE), framing(points, way)[0])


def _write(
    path: Path,
    pictures: Sequence[tuple[list[Painted], Viewpoint]],
    captions: Sequence[str] = (),
    columns: int = 2,
    key: _Key = (),
) -> Path:
    drawn = [draw(painted, np.zeros((0, 3)), view) for painted, view in pictures]
    write_file(path, image_bytes(sheet(drawn, captions, columns, key)))
    return path


def _patches(model: HandModel) -> _Paint:
    """Surface that may touch, in the colour of its finger."""

    def paint(samples: SurfaceSamples, mesh: trimesh.Trimesh) -> _Faces:
        rows = np.flatnonzero(model.contact_link == model.tree.link_names.index(samples.link))
        if len(rows):
            group = model.contact_group[rows[0]]
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


def _palmar_direction(model: HandModel, n: np.ndarray) -> np.ndarray:
    """Direction from which contact surface with normals (c, 3) is seen best."""
    weight = np.where(model.contact_body == 0, 2.0, 1.0)
    way = (weight[:, None] * n).sum(0)
    size = float(np.linalg.norm(way))
    if size < 0.15 * weight.sum():  # jaws that face each other: look across them
        return np.linalg.svd(n - n.mean(0), full_matrices=False)[2][-1]
    return way / size
