"""Training data of the predictor: partial clouds of objects by simulated cameras, and grasps with their palm points."""

from typing import NamedTuple

import numpy as np
import torch

from lgrasp.differentiable.kinematics import BodyKinematics
from lgrasp.geometry.poses import pose_matrix
from lgrasp.hand.model import HandModel
from lgrasp.learn.params import LearnParams
from lgrasp.object.model import ObjectModel
from lgrasp.picture.camera import central_camera, look_at
from lgrasp.picture.depth import LabelledMesh, render
from lgrasp.scenes.params import CameraParams
from lgrasp.scenes.records import CloudRecord
from lgrasp.scenes.render import add_noise, draw_offsets, merge_views

CAMERA = CameraParams.model_validate(
    {"views": 2, "width": 96, "height": 96, "angle": 40.0, "calibration": 0.003, "voxel": 0.0, "window": 2}
)
"""Of clouds that networks see."""
_CAMERA_DISTANCE = 4.0  # of a camera, in radii of the object
_LEAST_POINTS = 64  # of a cloud: an edge alone is no object


class Examples(NamedTuple):
    """One object with G grasps and V clouds of n points, all in its internal frame."""

    model: ObjectModel
    points: torch.Tensor
    """[m], (V, n, 3)."""
    normals: torch.Tensor
    """(V, n, 3)."""
    R: torch.Tensor
    """Rotation of the hand's base, (G, 3, 3)."""
    t: torch.Tensor
    """Its origin [m], (G, 3)."""
    q: torch.Tensor
    """Actuated joints [rad or m], (G, K)."""
    anchor: torch.Tensor
    """Palm point of each grasp: where the surface is nearest to the palm [m], (G, 3)."""


def make_examples(
    hand: HandModel,
    model: ObjectModel,
    T_hand_object: np.ndarray,
    q: np.ndarray,
    params: LearnParams,
    rng: np.random.Generator,
    clouds: int,
    device: str = "cpu",
) -> Examples:
    """Clouds and labels of one object.

    Args:
        T_hand_object: of each grasp as in a shard, x y z [m] qw qx qy qz, (G, 7).
        q: actuated joints [rad or m], (G, K).
    """
    T = np.linalg.inv(pose_matrix(T_hand_object.astype(float)))
    R, t = T[:, :3, :3], T[:, :3, 3] - model.center
    palm = t + R @ palm_point(hand)
    away = np.linalg.norm(palm[:, None] - model.contact_points[None], axis=2)
    anchor = model.contact_points[away.argmin(1)] if len(q) else np.zeros((0, 3))
    arrays = (*partial_clouds(model, clouds, params.points, rng, device), R, t, q, anchor)
    return Examples(model, *(torch.as_tensor(np.ascontiguousarray(a), dtype=torch.float32) for a in arrays))


def palm_point(hand: HandModel) -> np.ndarray:
    """Mean of the contact surface of the open hand in its base frame [m], (3,): a point before the palm."""
    R, t = BodyKinematics(hand.tree, dtype=torch.float64)(torch.as_tensor(hand.tree.joint_open[None].astype(float)))
    body = hand.contact_body
    points = np.einsum("nab,nb->na", R[0].cpu().numpy()[body], hand.contact_points) + t[0].cpu().numpy()[body]
    return points.mean(0)


def partial_clouds(
    model: ObjectModel, clouds: int, count: int, rng: np.random.Generator, device: str = "cpu"
) -> tuple[np.ndarray, np.ndarray]:
    """Noisy clouds of an object alone in space, each from two random sides.

    Returns:
        Points [m] in the internal frame and unit normals, (clouds, count, 3) each.
    """
    points, normals = np.zeros((clouds, count, 3)), np.zeros((clouds, count, 3))
    for made in range(clouds):
        seen = seen_cloud(model.vertices - model.center, model.faces, CAMERA, rng, device)
        kept = np.resize(rng.permutation(len(seen.points)), count)
        points[made], normals[made] = seen.points[kept], seen.normals[kept]
    return points, normals


def seen_cloud(
    vertices: np.ndarray, faces: np.ndarray, camera: CameraParams, rng: np.random.Generator, device: str
) -> CloudRecord:
    """What the cameras see of a mesh alone in space, from random sides, about the origin of its vertices [m]."""
    radius = float(np.linalg.norm(vertices, axis=1).max())
    surface = LabelledMesh(vertices, faces, np.zeros(len(faces)))
    lens = central_camera(camera.width, camera.height, camera.angle)
    while True:
        way = rng.standard_normal((camera.views, 3))
        way /= np.linalg.norm(way, axis=1)[:, None]
        if np.abs(way[:, 2]).max() > 0.98:  # no upright image
            continue
        images = render(surface, lens, look_at(_CAMERA_DISTANCE * radius * way, np.zeros(3)), device)
        merged = merge_views(add_noise(images, camera, rng), draw_offsets(camera, rng), camera, device)
        if len(merged.points) >= _LEAST_POINTS:
            return merged
