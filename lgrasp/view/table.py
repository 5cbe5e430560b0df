"""Objects on a table in a viewer: what cameras see of them, and grasps; a single object."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from lgrasp.errors import ConfigError
from lgrasp.geometry.poses import pose_matrix
from lgrasp.picture.draw import OBJECTS, TABLE, rgb
from lgrasp.picture.scene import STAGES, ContactMarks, GraspScene, HandShape, PlacedObject, Step, table_piece
from lgrasp.scenes.records import SceneRecord
from lgrasp.view.figure import GraspFigure, add_mesh, painted, place, show_all, stage_marks
from lgrasp.view.front import row_link
from lgrasp.view.page import Aim, add_saving
from lgrasp.view.server import View

if TYPE_CHECKING:
    import viser

_THICK = 0.01  # [m]
_POINT = 0.0015  # [m]
_AWAY = 2.0  # times as far as the objects need, to see hand and table


class TableView(View):
    """A scene: objects, table, cloud and its grasps one at a time; first the free ones, unless a row is asked for."""

    def __init__(self, server: "viser.ViserServer", scene: SceneRecord, row: int = 0) -> None:
        self._server, self._scene = server, scene
        records = [scene.objects[i] for i in scene.object_index]
        poses = pose_matrix(np.asarray(scene.object_pose, float))
        self._objects = [PlacedObject(record, T) for record, T in zip(records, poses, strict=True)]
        nodes = []
        for i, placed in enumerate(self._objects):
            nodes.append(add_mesh(server.scene, f"/object{i}", placed.mesh, OBJECTS[i % len(OBJECTS)]))
            place(nodes[-1], placed.pose)
        self._table = table_piece(scene.table, _THICK)
        nodes.append(add_mesh(server.scene, "/table", self._table, TABLE))
        colours = np.array([rgb(TABLE), *(rgb(colour) for colour in OBJECTS)], np.uint8)
        which = np.where(scene.cloud.labels == 0, 0, 1 + (scene.cloud.labels - 1) % len(OBJECTS))
        dark = (0.7 * colours[which]).astype(np.uint8)
        cloud = server.scene.add_point_cloud(
            "/cloud",
            scene.cloud.points,
            dark,
            point_size=_POINT,
            point_shape="circle",
            visible=False,
            precision="float32",
        )
        gui = server.gui
        gui.add_markdown(f"**scene {scene.index}** {', '.join(record.id for record in records)}")
        with gui.add_folder("show"):
            solid, points = gui.add_checkbox("objects and table", True), gui.add_checkbox("cloud", False)
        solid.on_update(lambda _: show_all(nodes, solid.value))
        points.on_update(lambda _: show_all([cloud], points.value))
        self._rows = np.argsort(~scene.grasps.collision_free, kind="stable")
        self._figure: GraspFigure | None = None
        if len(self._rows):
            self._shape = HandShape.of_record(scene.hand)
            self._figure = GraspFigure(server.scene, "/grasp")
            free = int(scene.grasps.collision_free.sum())
            gui.add_markdown(f"{free:,} grasps are free of collision; the other {len(self._rows) - free:,} come last.")
            self._at = gui.add_slider("grasp", 0, max(len(self._rows) - 1, 1), 1, 0)
            self._time = gui.add_slider("stage", 0.0, 2.0, 0.01, 1.0, marks=stage_marks(2.0))
            self._text = gui.add_markdown("")
            self._at.on_update(lambda _: self._show())
            self._time.on_update(lambda _: self._show())
            self._show()
            if row:
                self.go(row)
        add_saving(server, self, f"scene-{scene.index}")
        Aim([], [placed.placed for placed in self._objects], np.zeros((0, 3))).apply(server, np.zeros(3), _AWAY)

    def go(self, row: int) -> None:
        if not 0 <= row < len(self._rows):
            raise ConfigError(f"row {row} does not exist; the scene has {len(self._rows)}")
        self._at.value = int(np.flatnonzero(self._rows == row)[0])

    def meshes(self) -> trimesh.Scene:
        """Objects, table, and the hand."""
        scene = trimesh.Scene({"table": painted(self._table, TABLE)})
        for i, placed in enumerate(self._objects):
            scene.add_geometry(painted(placed.placed, OBJECTS[i % len(OBJECTS)]), f"object{i}", f"object{i}")
        if self._figure is not None:
            T = pose_matrix(np.concatenate([self._figure.frame.position, self._figure.frame.wxyz]))
            for name, mesh in self._figure.meshes().items():
                scene.add_geometry(mesh, name, name, transform=T)
        return scene

    def _show(self) -> None:
        assert self._figure is not None
        grasps, row = self._scene.grasps, int(self._rows[int(np.clip(self._at.value, 0, len(self._rows) - 1))])
        stages = {name: getattr(grasps, column)[row] for name, column in STAGES.items()}
        nothing = ContactMarks(*(np.zeros((0, 3)) for _ in range(3)), np.zeros(0, int))
        with self._server.atomic():
            self._figure.show(GraspScene(self._shape, (), nothing, (Step(stages, 0),)))
            place(self._figure.frame, pose_matrix(np.asarray(grasps.hand_pose[row], float)))
            self._figure.move(self._time.value)
        target = self._objects[grasps.target[row]].record.id
        free = "free of collision" if grasps.collision_free[row] else "collides"
        self._text.content = f"row {row:,}: {target}, {free}; {row_link(row)}"


class ObjectView(View):
    """A mesh with its size."""

    def __init__(self, server: "viser.ViserServer", name: str, mesh: trimesh.Trimesh, notes: Sequence[str]) -> None:
        self._mesh = mesh
        add_mesh(server.scene, "/object", mesh, OBJECTS[0])
        server.scene.add_frame("/axes", axes_length=0.03, axes_radius=0.0008)
        sides = " x ".join(f"{1000 * side:.0f}" for side in mesh.extents)
        lines = [f"**{name}**, {sides} mm, {len(mesh.faces):,} faces", *(f"- {note}" for note in notes)]
        server.gui.add_markdown("\n\n".join(lines))
        add_saving(server, self, name)
        Aim([], [mesh], np.zeros((0, 3))).apply(server, np.zeros(3))

    def meshes(self) -> trimesh.Scene:
        """The mesh."""
        return trimesh.Scene(self._mesh)
