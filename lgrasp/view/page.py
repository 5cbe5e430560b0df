"""What every page has: cameras that see all of it, pictures and GLB files out of it."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from PIL import Image
from trimesh.exchange.gltf import export_glb

from lgrasp.geometry.poses import pose_matrix
from lgrasp.picture.draw import ANGLE, choose_viewpoint
from lgrasp.picture.sheet import image_bytes
from lgrasp.view.server import View

if TYPE_CHECKING:
    import viser

_ROOM = 1.25  # times as far away as it must be
_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # glTF has y up
_PATIENCE = 20.0  # [s] for a browser to draw a picture


class Aim:
    """Where browsers look from: where links, objects and contacts [m], shape (c, 3), are seen best."""

    def __init__(
        self, links: Sequence[trimesh.Trimesh], objects: Sequence[trimesh.Trimesh], contacts: np.ndarray
    ) -> None:
        pose = choose_viewpoint(links, objects, contacts, 256).pose
        low, high = trimesh.util.concatenate([*links, *objects]).bounds
        self._middle, self._way = (low + high) / 2, _ROOM * (pose[:3] - (low + high) / 2)
        R = pose_matrix(pose)[:3, :3]
        self.right: np.ndarray = R[:, 0]
        """On the screen, unit."""
        self.down: np.ndarray = R[:, 1]

    def spans(self, meshes: Sequence[trimesh.Trimesh]) -> np.ndarray:
        """How far meshes go to the right and down on the screen [m], shape (2,)."""
        points = np.concatenate([mesh.vertices for mesh in meshes])
        return np.ptp(points @ np.stack([self.right, self.down], 1), axis=0)

    def apply(self, server: "viser.ViserServer", shift: np.ndarray, factor: float = 1.0) -> None:
        """Move all cameras; ``shift`` [m] is added to what is looked at, ``factor`` times as far away as needed."""
        clients = server.get_clients().values()
        for camera in (server.initial_camera, *(client.camera for client in clients)):
            camera.position = self._middle + shift + factor * self._way
            camera.look_at = self._middle + shift
            camera.fov = float(np.radians(ANGLE))


def add_saving(server: "viser.ViserServer", view: View, name: str) -> None:
    """Buttons that save what is shown."""
    picture = server.gui.add_button("save picture (PNG)")
    model = server.gui.add_button("save model (GLB)")

    @picture.on_click
    def _(event: "viser.GuiEvent") -> None:
        client = event.client
        if client is not None:
            size = client.camera.image_height, client.camera.image_width
            seen = Image.fromarray(client.get_render(*size, transport_format="png", timeout=_PATIENCE))
            image = Image.alpha_composite(Image.new("RGBA", seen.size, "#ffffff"), seen).convert("RGB")
            client.send_file_download(f"{name}.png", image_bytes(image), save_immediately=True)

    @model.on_click
    def _(event: "viser.GuiEvent") -> None:
        if event.client is not None:
            scene = view.meshes()
            scene.apply_transform(_Z_UP)
            data = export_glb(scene)
            event.client.send_file_download(f"{name}.glb", data, save_immediately=True)
