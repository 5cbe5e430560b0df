"""Where the optimisers start: the hand faces a random point of the object's hull, open or as its last step left it."""

from collections.abc import Sequence

import numpy as np
import torch
import trimesh

from lgrasp.geometry.clusters import CLUSTER_SIZE
from lgrasp.hand.model import HandModel
from lgrasp.object.model import ObjectModel


def start_poses(
    hand: HandModel, objects: Sequence[ObjectModel], held: tuple[torch.Tensor, torch.Tensor], u: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Poses R (N, 3, 3) and t (N, 3) [m] of the last object, f64: a hull point in front of the hand, any roll.

    A point of the object's convex hull, uniform by area, comes to a point of the hand's canonical box, with the hull's
    normal towards the palm; and as far out along that line as clears the balls around the objects held.

    Args:
        held: poses of the objects before, R (N, n - 1, 3, 3) and t (N, n - 1, 3).
        u: uniform numbers, (N, 7) f64.
    """
    new = objects[-1]
    hull = trimesh.convex.convex_hull(new.vertices.astype(float) - new.center)
    axis, low, high = _front(hand)
    corners = torch.tensor(hull.triangles).to(u)
    share = torch.from_numpy(hull.area_faces.cumsum() / hull.area_faces.sum()).to(u)
    face = torch.searchsorted(share, u[:, 0].contiguous()).clamp_max(len(corners) - 1)
    a, b, c = corners[face].unbind(1)
    r = u[:, 1:2].sqrt()
    point = (1 - r) * a + r * (1 - u[:, 2:3]) * b + r * u[:, 2:3] * c
    normal = torch.tensor(hull.face_normals).to(u)[face]
    forward = torch.from_numpy(axis).to(u)
    roll = 2 * torch.pi * u[:, 3:4]
    # frames with the given third axis; the second one is rolled
    A, B = _frame(-forward.expand_as(normal)), _frame(normal)
    x, y = A[..., 0] * roll.cos() + A[..., 1] * roll.sin(), A[..., 1] * roll.cos() - A[..., 0] * roll.sin()
    R = torch.stack([x, y, A[..., 2]], -1) @ B.transpose(1, 2)
    at = torch.from_numpy(low).to(u) + u[:, 4:] * torch.from_numpy(high - low).to(u)
    if len(objects) > 1:
        radius = torch.tensor([float(np.linalg.norm(o.obstacle_points, axis=1).max()) for o in objects[:-1]]).to(u)
        beyond = ((held[1].to(u) - at[:, None]) @ forward + radius).amax(1)
        at = at + beyond.clamp_min(0)[:, None] * forward
    return R, at - (R @ point[..., None])[..., 0]


def _front(hand: HandModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The direction in which the palm faces, and the corners of the canonical box."""
    low, high = hand.canonical_box.astype(float)
    base = hand.samples[: hand.cluster_first[1] * CLUSTER_SIZE]
    centre = 0.5 * (low + high)
    nearest = base[np.linalg.norm(base - centre, axis=1).argmin()] if len(base) else np.zeros(3)
    return (centre - nearest) / max(float(np.linalg.norm(centre - nearest)), 1e-9), low, high


def _frame(z: torch.Tensor) -> torch.Tensor:
    """Rotations (N, 3, 3) whose third column is z (N, 3)."""
    smallest = z.abs().argmin(1, keepdim=True)
    x = torch.linalg.cross(z, torch.zeros_like(z).scatter(1, smallest, 1.0))
    x = x / x.norm(dim=1, keepdim=True)
    return torch.stack([x, torch.linalg.cross(z, x), z], -1)
