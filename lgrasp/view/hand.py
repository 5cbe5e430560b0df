"""A hand in a viewer: joints to move, what may touch, opposition spaces, collision pieces, its palmar side."""

import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from lgrasp.hand.find import HandSource
from lgrasp.hand.model import HandModel
from lgrasp.hand.opposition.spaces import space_sides
from lgrasp.hand.surface_visibility import visible_surface
from lgrasp.hand.urdf import read_urdf
from lgrasp.picture.draw import OBJECTS, rgb
from lgrasp.picture.scene import HandShape
from lgrasp.view.figure import HandFigure, add_mesh, show_all
from lgrasp.view.page import Aim, add_saving
from lgrasp.view.server import View

if TYPE_CHECKING:
    import viser

_POINT = 0.0025  # [m]
_AIMED = 60  # contact points that the first camera is to see
_SIDES = ("#d62728", "#1f77b4")
_PALMAR = "#2ca02c"
_NONE = "none"


_Nodes = Sequence["viser.SceneNodeHandle"]
_Make = Callable[[], _Nodes]


class HandView(View):
    """A hand with a slider for each joint that is driven."""

    def __init__(self, server: "viser.ViserServer", source: HandSource, model: HandModel) -> None:
        self._server, self._source, self._model, self._tree = server, source, model, model.tree
        self._lock = threading.RLock()
        self._shown: dict[str, _Nodes] = {}
        shape = HandShape(read_urdf(source.urdf), self._tree.base_link, self._tree.listed_names)
        self._figure = HandFigure(server.scene, "/hand", shape)
        gui = server.gui
        gui.add_markdown(f"**{model.name}** {source.spec.description}")
        self._layers: dict[str, _Make] = {
            "contact patches": self._patches,
            "palmar side": self._palmar,
            "collision pieces": self._pieces,
            "canonical box": self._box,
            **{name: partial(self._sides, name) for name in source.spec.opposition_spaces},
        }
        with gui.add_folder("show"):
            for name in list(self._layers)[:4]:
                box = gui.add_checkbox(name, name == "contact patches")
                box.on_update(partial(self._ticked, name))
            surface = gui.add_checkbox("surface", True)
            surface.on_update(lambda _: show_all(self._figure.meshes.values(), surface.value))
            spaces = gui.add_dropdown("opposition space", (_NONE, *source.spec.opposition_spaces), initial_value=_NONE)
            spaces.on_update(lambda _: self._space(spaces.value))
        with gui.add_folder("joints"):
            opened = gui.add_button("open posture")
            drawn = gui.add_button("random posture")
            limits = zip(self._tree.joint_names, self._tree.joint_lower, self._tree.joint_upper, strict=True)
            self._joints = [
                gui.add_slider(name, float(low), float(high), 0.001, float(np.clip(q, low, high)))
                for (name, low, high), q in zip(limits, self._tree.joint_open, strict=True)
            ]
        for slider in self._joints:
            slider.on_update(lambda _: self._move())
        opened.on_click(lambda _: self.take(self._tree.joint_open))
        drawn.on_click(
            lambda _: self.take(model.random_postures(1, seed=int(np.random.default_rng().integers(2**31)))[0])
        )
        add_saving(server, self, model.name)
        self.show("contact patches", True)
        self._move()
        frames, some = shape.poses(self._listed()[None]), slice(None, None, max(1, len(model.contact_points) // _AIMED))
        touching = [
            (frames[self._tree.link_names[i]][0] @ np.linalg.inv(self._tree.T_body_link[i]) @ [*p, 1.0])[:3]
            for i, p in zip(model.contact_link[some], model.contact_points[some], strict=True)
        ]
        links = list(shape.placed(self._listed()).values())
        Aim(links, [], np.array(touching).reshape(-1, 3)).apply(server, np.zeros(3))

    def meshes(self) -> trimesh.Scene:
        """The links as they are."""
        return trimesh.Scene(list(self._figure.shape.placed(self._listed()).values()))

    def _listed(self) -> np.ndarray:
        """Values of all listed joints, shape (K + ...)."""
        return self._tree.listed_values(np.array([[slider.value for slider in self._joints]]))[0]

    def take(self, q: np.ndarray) -> None:
        """Take a posture [rad or m], shape (K,), as far as the limits allow."""
        for slider, value in zip(self._joints, q, strict=True):
            slider.value = round(float(np.clip(value, slider.min, slider.max)), 4)
        self._move()

    def _move(self) -> None:
        with self._lock, self._server.atomic():
            self._figure.move(self._listed())

    def show(self, layer: str, visible: bool) -> int:
        """Show a layer, made anew, or take it away; how many nodes it has then."""
        with self._lock:
            for node in self._shown.pop(layer, []):
                node.remove()
            if visible:
                self._shown[layer] = self._layers[layer]()
            return len(self._shown.get(layer, []))

    def _ticked(self, layer: str, event: "viser.GuiEvent") -> None:
        self.show(layer, event.target.value)

    def _space(self, name: str) -> None:
        """Show the sides of one space, or of none."""
        for other in self._source.spec.opposition_spaces:
            self.show(other, other == name)

    def _points(self, name: str, link: np.ndarray, points: np.ndarray, colours: np.ndarray) -> _Nodes:
        """Points (n, 3) in body frames on links, by index, in colours (n, 3)."""
        nodes = []
        for index in np.unique(link):
            of, own = self._tree.link_names[index], link == index
            T = np.linalg.inv(self._tree.T_body_link[index])
            local = points[own] @ T[:3, :3].T + T[:3, 3]
            path = f"/hand/{of}/{name}"
            nodes.append(
                self._server.scene.add_point_cloud(
                    path, local, colours[own], point_size=_POINT, point_shape="circle", precision="float32"
                )
            )
        return nodes

    def _patches(self) -> _Nodes:
        model = self._model
        colours = np.array([rgb(colour) for colour in OBJECTS], np.uint8)[model.contact_group % len(OBJECTS)]
        return self._points("patches", model.contact_link, model.contact_points, colours)

    def _palmar(self) -> _Nodes:
        side = visible_surface(self._source, self._model)
        return self._points("palmar", side.link, side.points, np.tile(rgb(_PALMAR), (len(side.link), 1)))

    def _sides(self, name: str) -> _Nodes:
        sides = space_sides(read_urdf(self._source.urdf), self._source.spec, self._tree, name)
        nodes = []
        for number, (side, colour) in enumerate(zip(sides, _SIDES, strict=True)):
            for part in side:
                link = np.full(len(part.points), self._tree.link_names.index(part.link))
                nodes += self._points(f"side{number}", link, part.points, np.tile(rgb(colour), (len(link), 1)))
        return nodes

    def _pieces(self) -> _Nodes:
        nodes = []
        for i, link in enumerate(self._model.piece_link):
            piece = self._model.piece(i)
            points = piece.vertices
            if piece.radius > 0:
                ball = trimesh.creation.icosphere(subdivisions=2, radius=piece.radius).vertices
                points = (points[:, None] + ball).reshape(-1, 3)
            mesh = trimesh.convex.convex_hull(points).apply_transform(np.linalg.inv(self._tree.T_body_link[link]))
            path = f"/hand/{self._tree.link_names[link]}/piece{i}"
            nodes.append(add_mesh(self._server.scene, path, mesh, OBJECTS[i % len(OBJECTS)], opacity=0.6))
        return nodes

    def _box(self) -> _Nodes:
        low, high = self._model.canonical_box
        x, y, z = (high - low).tolist()
        box = self._server.scene.add_box("/box", color=(40, 40, 40), dimensions=(x, y, z), wireframe=True)
        box.position = (low + high) / 2
        return [box]
