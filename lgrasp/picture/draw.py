"""Pictures of scenes without a screen: a camera that sees hand, objects and contacts, shaded by rays."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh
import warp as wp

from lgrasp.geometry.poses import device_from_stored
from lgrasp.geometry.union import joined_mesh
from lgrasp.picture import shade_kernels as kernels
from lgrasp.picture.camera import Intrinsics, central_camera, look_at
from lgrasp.picture.depth import LabelledMesh, join_surfaces, render
from lgrasp.picture.scene import GraspScene, balls, split_edges, table_piece
from lgrasp.runtime.device import start
from lgrasp.runtime.fetch import to_numpy

HAND = ("#a9b6c6", "#8796a8")
"""Colours of links, in turns."""
OBJECTS = ("#f2a33c", "#4fa79a", "#c66fb4", "#86b04a", "#d9695c", "#5f86d9")
CONTACT = "#b3001b"
TABLE = "#d8d8d8"

ANGLE = 22.0
"""Field of view [deg]."""
_ELEVATIONS = (10.0, 30.0)  # [deg] from which it may look
_AZIMUTHS = 16
_SKETCH = 28  # [pixels] of the images by which its place is chosen
_DOT = 0.034  # radius of a contact's dot over half the side of the picture
_SHOWN = 0.13  # [m] so close to an object the hand is in the picture, whatever belongs to it
_MARGIN = 1.05
_THROUGH = 0.45  # share of a dot that is seen through what hides it
_SAMPLES, _RAYS = 4, 2  # through a pixel, and from each surface that they meet
_HAND, _OBJECT, _CONTACT = 0, 1, 2  # labels in sketches


class Painted(NamedTuple):
    """A mesh in the scene frame [m] and its colour, or those of its faces."""

    mesh: trimesh.Trimesh
    colour: str | Sequence[str]
    """Such as #ff8800."""


class Viewpoint(NamedTuple):
    """A camera."""

    intrinsics: Intrinsics
    pose: np.ndarray
    """T_scene_camera, x y z [m] qw qx qy qz, shape (7,)."""


def draw_scene(scene: GraspScene, size: int, times: Sequence[float], colour: int) -> Iterator[np.ndarray]:
    """The last step of a row at some times, by one camera, contacts as dots; sRGB, each (size, size, 3), uint8. A
    table is level.

    Args:
        times: rising; 0 pregrasp, 1 grasp, 2 squeeze.
        colour: which of the colours of objects the first one has.
    """
    stages = list(scene.steps[-1].stages.values())
    first, last = int(times[0]), int(np.ceil(times[-1]))
    upright = np.eye(4) if scene.table is None else np.linalg.inv(scene.table)

    def placed_links(q: np.ndarray) -> list[trimesh.Trimesh]:
        return [mesh.apply_transform(upright) for mesh in scene.hand.placed(q).values()]

    objects = [placed.placed.apply_transform(upright) for placed in scene.objects]
    points = trimesh.transform_points(scene.contacts.points, upright)
    view = choose_viewpoint([m for q in stages[first : last + 1] for m in placed_links(q)], objects, points, size)
    still = [Painted(mesh, OBJECTS[i % len(OBJECTS)]) for i, mesh in enumerate(objects, colour)]
    if scene.table is not None:
        still.append(Painted(table_piece(), TABLE))
    for time in times:
        q, _ = scene.at(scene.duration - len(stages) + 1 + time)
        moving = [Painted(mesh, HAND[i % len(HAND)]) for i, mesh in enumerate(placed_links(q))]
        yield draw(moving + still, points, view)


def choose_viewpoint(
    links: Sequence[trimesh.Trimesh], objects: Sequence[trimesh.Trimesh], contacts: np.ndarray, size: int
) -> Viewpoint:
    """The camera that sees most of the objects and of the contacts, of those around and somewhat above.

    Args:
        contacts: [m], shape (c, 3).
        size: pixels of a side of the image.
    """
    held = np.concatenate([mesh.vertices for mesh in objects] or [mesh.vertices for mesh in links])
    points = np.concatenate([held, *(mesh.vertices for mesh in links)])
    low, high = held.min(0) - _SHOWN, held.max(0) + _SHOWN
    points = points[((points > low) & (points < high)).all(1)]
    turn, rise = np.meshgrid(2 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS, np.radians(_ELEVATIONS))
    ways = np.stack([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)], -1).reshape(-1, 3)
    poses = np.concatenate([framing(points, way) for way in ways])
    dots = balls(contacts, 0.003, 1) if len(contacts) else None
    parts = [*((m, _HAND) for m in links), *((m, _OBJECT) for m in objects), *([(dots, _CONTACT)] if dots else [])]
    surface = join_surfaces([LabelledMesh(m.vertices, m.faces, np.full(len(m.faces), label)) for m, label in parts])
    labels = render(surface, central_camera(_SKETCH, _SKETCH, ANGLE), poses).labels
    seen = [(labels == label).sum((1, 2)) for label in (_HAND, _OBJECT, _CONTACT)]
    score = sum(weight * n / max(n.max(), 1) for weight, n in zip((0.3, 1.0, 0.7), seen, strict=True))
    return Viewpoint(central_camera(size, size, ANGLE), poses[int(np.argmax(score))])


def framing(points: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Pose (1, 7) of the camera in a direction (3,) from points (n, 3) that sees all of them, as near as it can."""
    right = np.cross([0.0, 0.0, 1.0], way) / np.linalg.norm(way[:2])
    axes = np.stack([right, np.cross(way, right), way])
    local = points @ axes.T
    middle = (local.min(0) + local.max(0)) / 2
    tangent = np.tan(np.radians(ANGLE / 2))
    far = (np.abs(local - middle)[:, :2].max(1) * _MARGIN / tangent + local[:, 2] - middle[2]).max()
    target = middle @ axes
    return look_at((target + far * way)[None], target)


def draw(painted: Sequence[Painted], dots: np.ndarray, view: Viewpoint) -> np.ndarray:
    """What a camera sees, white behind all: sRGB, shape (h, w, 3), uint8; ``dots`` [m], shape (n, 3), show through
    everything."""
    start()
    intrinsics = view.intrinsics
    solids, mesh = _upload(painted)
    points = dots if len(dots) else np.full((1, 3), 1e3)
    far = np.linalg.norm(points - view.pose[:3], axis=1).min()
    marks, dot_mesh = _upload([Painted(balls(points, _DOT * far * np.tan(np.radians(ANGLE / 2)), 3), CONTACT)])
    camera, light = kernels.Camera(), kernels.Lighting()
    camera.pose = wp.transform(*map(float, device_from_stored(view.pose[None])[0]))
    camera.focal = wp.vec2(intrinsics.fx, intrinsics.fy)
    camera.centre = wp.vec2(intrinsics.cx, intrinsics.cy)
    R = np.asarray(wp.quat_to_matrix(wp.transform_get_rotation(camera.pose))).reshape(3, 3)
    towards = R @ np.array([-0.5, -0.75, -0.75])  # over the left shoulder
    light.towards = wp.vec3(*map(float, towards / np.linalg.norm(towards)))
    light.sun, light.shine, light.softness, light.reach = 0.9, 0.06, 0.25, 0.06
    light.above, light.below = wp.vec3(0.50, 0.52, 0.55), wp.vec3(0.28, 0.26, 0.25)
    light.samples, light.rays, light.through = _SAMPLES, _RAYS, _THROUGH
    out = wp.empty((intrinsics.height, intrinsics.width), dtype=wp.vec3, device="cpu")
    wp.launch(kernels.shade, out.shape, [solids, marks, camera, light, wp.vec3(1.0, 1.0, 1.0)], [out], device="cpu")
    colour = np.clip(to_numpy(out), 0, 1)
    del mesh, dot_mesh  # kept alive until here
    srgb = np.where(colour < 0.0031308, 12.92 * colour, 1.055 * colour ** (1 / 2.4) - 0.055)
    return np.rint(255 * srgb).astype(np.uint8)


def _upload(painted: Sequence[Painted]) -> tuple[Any, wp.Mesh]:
    """Meshes as one on the device, to be kept as long as it is used."""
    whole = split_edges(joined_mesh([part.mesh for part in painted]))
    colours = [
        np.broadcast_to(_linear([part.colour] if isinstance(part.colour, str) else part.colour), part.mesh.faces.shape)
        for part in painted
    ]
    mesh = wp.Mesh(
        wp.array(whole.vertices.astype(np.float32), dtype=wp.vec3, device="cpu"),
        wp.array(whole.faces.ravel().astype(np.int32), dtype=wp.int32, device="cpu"),
    )
    solids = kernels.PaintedMesh()
    solids.mesh = mesh.id
    normals = whole.vertex_normals[whole.faces].reshape(-1, 3)
    solids.corner_normal = wp.array(normals.astype(np.float32), dtype=wp.vec3, device="cpu")
    solids.colour = wp.array(np.concatenate(colours).astype(np.float32), dtype=wp.vec3, device="cpu")
    return solids, mesh


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue, 0 to 255, of a colour such as #ff8800."""
    r, g, b = bytes.fromhex(colour[1:])
    return r, g, b


def _linear(colours: Sequence[str]) -> np.ndarray:
    """Linear colours (n, 3) of sRGB ones such as #ff8800."""
    names, which = np.unique(np.asarray(colours), return_inverse=True)
    srgb = np.array([rgb(name) for name in names]) / 255
    return np.where(srgb < 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)[which.ravel()]
