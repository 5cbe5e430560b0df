"""What the network sees of solids: distances from fixed basis points to clouds of their surfaces."""

import numpy as np
import torch

from lgrasp.geometry.rotations import matrix_from_quaternion
from lgrasp.object.surface import sample_surface

SHAPE_RADIUS = 0.08
"""Radius of the ball of basis points around an object [m]."""
HELD_MARGIN = 0.05
"""How far basis points of what is held reach beyond the hand's canonical box [m]."""
_SHAPE_UNIT, _HELD_REACH = 0.05, 0.04  # [m] unit of a distance; distance at which what is held is seen no more
_HELD_CLOUD = 256  # points of a cloud that held objects are seen by
_CHUNK = 1 << 24  # distances at a time


def mesh_centre(vertices: np.ndarray) -> np.ndarray:
    """Centre of the bounding box of vertices (v, 3) [m], (3,)."""
    vertices = np.asarray(vertices, float)
    return 0.5 * (vertices.min(0) + vertices.max(0))


def surface_cloud(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Points of a mesh's surface about :func:`mesh_centre` [m], (count, 3) f32."""
    points, _ = sample_surface(np.asarray(vertices, float) - mesh_centre(vertices), np.asarray(faces), count, seed=0)
    return points[:count].astype(np.float32)


def ball_points(count: int, radius: float, seed: int) -> torch.Tensor:
    """Evenly random points in a ball about the origin [m], (count, 3)."""
    draw = torch.Generator().manual_seed(seed)
    way = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=1)
    return radius * way * torch.rand(count, 1, generator=draw) ** (1 / 3)


def box_points(count: int, low: np.ndarray, high: np.ndarray, seed: int) -> torch.Tensor:
    """Evenly random points in a box [m], (count, 3)."""
    draw = torch.Generator().manual_seed(seed)
    a, b = (torch.as_tensor(x, dtype=torch.float32) for x in (low, high))
    return a + (b - a) * torch.rand(count, 3, generator=draw)


def random_rotations(count: int, draw: torch.Generator) -> torch.Tensor:
    """Evenly distributed rotations, (count, 3, 3); the first is none."""
    turns = matrix_from_quaternion(torch.nn.functional.normalize(torch.randn(count, 4, generator=draw), dim=1))
    turns[0] = torch.eye(3)
    return turns


def shape_features(basis: torch.Tensor, cloud: torch.Tensor, turns: torch.Tensor) -> torch.Tensor:
    """Distances from basis points (B, 3) to a cloud (n, 3) turned by each of V rotations, (V, B), in units of 5 cm."""
    parts = [torch.cdist(basis @ turn, cloud).amin(1) for turn in turns]  # basis points in the cloud's frame
    return torch.stack(parts) / _SHAPE_UNIT


def held_features(
    basis: torch.Tensor, clouds: torch.Tensor, objects: torch.Tensor, R: torch.Tensor, t: torch.Tensor
) -> torch.Tensor:
    """How near basis points in the hand frame are to objects that are held, (N, B): 1 on a surface, 0 from 4 cm on.

    Args:
        basis: (B, 3) [m].
        clouds: of all objects, centred, (O, n, 3) [m].
        objects: which are held, (N, S) int64; -1: none.
        R, t: their poses in the hand frame, (N, S, 3, 3) and (N, S, 3) [m].
    """
    near = torch.full((len(objects), len(basis)), torch.inf, device=basis.device)
    clouds = clouds[:, :_HELD_CLOUD]
    size = max(1, _CHUNK // (len(basis) * clouds.shape[1]))
    for slot in range(objects.shape[1]):
        for rows in (objects[:, slot] >= 0).nonzero()[:, 0].split(size):
            local = (basis - t[rows, slot, None]) @ R[rows, slot]  # (n, B, 3) in the object's frame
            near[rows] = near[rows].minimum(torch.cdist(local, clouds[objects[rows, slot]]).amin(2))
    return (1 - near / _HELD_REACH).clamp_min(0)
