"""A hand, objects and contacts in the scene of a viewer."""

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import trimesh

from lgrasp.geometry.poses import pose_from_matrix
from lgrasp.geometry.union import joined_mesh
from lgrasp.grasp.records import ObjectRecord
from lgrasp.picture.draw import CONTACT, HAND, OBJECTS, TABLE, rgb
from lgrasp.picture.scene import STAGES, GraspScene, HandShape, balls, split_edges, table_piece

if TYPE_CHECKING:
    import viser

FORCE = "#1f4fd1"
NORMAL = "#1a1a1a"
_DOT = 0.003  # [m]
_NORMAL = 0.02  # [m]
_THIN = 0.001  # [m]
_FORCE = 0.08  # [m] of the sum of the normal forces
_CONE = 0.018  # [m]


class Marks(NamedTuple):
    """What is shown of contacts, and whether the hand hides it."""

    contacts: bool = True
    normals: bool = False
    forces: bool = True
    cones: bool = False
    see_through: bool = False


def stage_marks(duration: float) -> tuple[tuple[float, str], ...]:
    """What to write at the times of :meth:`GraspScene.at` on a slider: the stages, or of a sequence its grasps."""
    if duration < len(STAGES):
        return tuple((float(i), name) for i, name in enumerate(STAGES))
    return tuple((time, f"object {i}") for i, time in enumerate(np.arange(1.0, duration, len(STAGES)).tolist(), 1))


def show_all(nodes: "Iterable[viser.SceneNodeHandle]", visible: bool) -> None:
    """Show or hide nodes."""
    for node in nodes:
        node.visible = visible


def place(node: "viser.SceneNodeHandle", T: np.ndarray) -> None:
    """Move a node to a pose (4, 4) in the frame of its parent."""
    pose = pose_from_matrix(T[None])[0]
    node.position, node.wxyz = pose[:3], pose[3:]


def add_mesh(
    scene: "viser.SceneApi", name: str, mesh: trimesh.Trimesh, colour: str, opacity: float | None = None
) -> "viser.MeshHandle":
    """A mesh with smooth curved parts and sharp edges."""
    split = split_edges(mesh)
    return scene.add_mesh_simple(
        name, split.vertices, split.faces, color=rgb(colour), opacity=opacity, side="double", cast_shadow=False
    )


def painted(mesh: trimesh.Trimesh, colour: str) -> trimesh.Trimesh:
    """The mesh itself, in a colour."""
    mesh.visual.face_colors = [*rgb(colour), 255]  # ty: ignore[invalid-assignment]
    return mesh


class HandFigure:
    """The links of a hand, each a frame with its mesh, below a node."""

    def __init__(self, scene: "viser.SceneApi", name: str, shape: HandShape) -> None:
        self.shape = shape
        self.frames = {link: scene.add_frame(f"{name}/{link}", show_axes=False) for link in shape.links}
        self.meshes = {
            link: add_mesh(scene, f"{name}/{link}/surface", mesh, HAND[i % len(HAND)])
            for i, (link, mesh) in enumerate(shape.links.items())
        }

    def move(self, q: np.ndarray) -> None:
        """Take a posture, shape (K,)."""
        for link, T in self.shape.poses(q[None]).items():
            place(self.frames[link], T[0])


class GraspFigure:
    """A row below a node: what stays from row to row is sent to browsers once."""

    def __init__(self, scene: "viser.SceneApi", name: str) -> None:
        self._scene, self.name = scene, name
        self.frame = scene.add_frame(name, show_axes=False)
        self._hand: HandFigure | None = None
        self._objects: list[tuple[ObjectRecord, viser.MeshHandle]] = []
        self._table: viser.MeshHandle | None = None
        self._marks: list[tuple[int, viser.SceneNodeHandle]] = []  # with the object that is touched
        self.shown: GraspScene | None = None
        self._time = 0.0

    def show(self, grasp: GraspScene) -> None:
        """Show another row; the posture comes with :meth:`move`."""
        if self._hand is None or self._hand.shape is not grasp.hand:
            if self._hand is not None:
                self._scene.remove_by_name(f"{self.name}/hand")
            self._scene.add_frame(f"{self.name}/hand", show_axes=False)
            self._hand = HandFigure(self._scene, f"{self.name}/hand", grasp.hand)
        before = self._objects
        self._objects = []
        for i, placed in enumerate(grasp.objects):
            same = i < len(before) and before[i][0] is placed.record
            colour = OBJECTS[i % len(OBJECTS)]
            node = before[i][1] if same else add_mesh(self._scene, f"{self.name}/object{i}", placed.mesh, colour)
            place(node, placed.pose)
            self._objects.append((placed.record, node))
        for _, node in before[len(grasp.objects) :]:
            node.remove()
        if self._table is not None:
            self._table.remove()
            self._table = None
        if grasp.table is not None:
            self._table = add_mesh(self._scene, f"{self.name}/table", table_piece(), TABLE, opacity=0.25)
            place(self._table, grasp.table)
        self.shown = grasp

    def move(self, time: float) -> None:
        """Show the grasp at a time, see :meth:`GraspScene.at`."""
        assert self.shown is not None
        assert self._hand is not None
        self._time = time
        q, held = self.shown.at(time)
        self._hand.move(q)
        for i, node in [*enumerate(node for _, node in self._objects), *self._marks]:
            node.visible = i < held

    def mark(self, marks: Marks, friction: float) -> None:
        """Show contacts and what acts there, of the objects in the hand."""
        for _, node in self._marks:
            node.remove()
        assert self.shown is not None
        assert self._hand is not None
        for mesh in self._hand.meshes.values():
            mesh.opacity = 0.35 if marks.see_through else None
        of = self.shown.contacts.of
        self._marks = [(int(i), node) for i in np.unique(of) for node in self._marked(marks, friction, of == i, i)]
        self.move(self._time)

    def _marked(
        self, marks: Marks, friction: float, chosen: np.ndarray, number: int
    ) -> "Iterator[viser.SceneNodeHandle]":
        """Nodes of the contacts of one object."""
        assert self.shown is not None
        points, normals, forces, _ = (values[chosen] for values in self.shown.contacts)
        scene, name = self._scene, f"{self.name}/marks{number}"
        if marks.contacts:
            yield add_mesh(scene, f"{name}/contacts", balls(points, _DOT), CONTACT)
        if marks.normals:
            lines = np.stack([points, points + _NORMAL * normals], 1)
            yield scene.add_line_segments(f"{name}/normals", lines, rgb(NORMAL), thickness=_THIN)
        if marks.forces and np.isfinite(forces).all():
            arrows = np.stack([points - _FORCE * forces, points], 1)
            yield scene.add_arrows(
                f"{name}/forces", arrows, rgb(FORCE), shaft_radius=0.001, head_radius=0.0025, head_length=0.007
            )
        if marks.cones:
            cone = trimesh.creation.cone(_CONE * friction, _CONE).apply_translation([0, 0, -_CONE])
            turns = [trimesh.geometry.align_vectors([0, 0, -1], normal) for normal in normals]
            cones = [cone.copy().apply_transform(T).apply_translation(p) for T, p in zip(turns, points, strict=True)]
            yield add_mesh(scene, f"{name}/cones", joined_mesh(cones), FORCE, opacity=0.35)

    def meshes(self) -> dict[str, trimesh.Trimesh]:
        """What is shown, without marks, in the frame of the node."""
        assert self.shown is not None
        q, held = self.shown.at(self._time)
        found = {name: painted(mesh, HAND[0]) for name, mesh in self.shown.hand.placed(q).items()}
        for i, placed in enumerate(self.shown.objects[:held]):
            found[f"object{i}"] = painted(placed.placed, OBJECTS[i % len(OBJECTS)])
        if self.shown.table is not None:
            found["table"] = painted(table_piece().apply_transform(self.shown.table), TABLE)
        return found
