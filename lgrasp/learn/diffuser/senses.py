"""What a hand feels in a pose: how far points of its surface are from the object to grasp and from those it holds."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from lgrasp.differentiable.distance import DistanceGrids
from lgrasp.differentiable.kinematics import BodyKinematics
from lgrasp.geometry.clusters import CLUSTER_SIZE
from lgrasp.hand.contact_surface import contact_surface
from lgrasp.hand.model import HandModel
from lgrasp.hand.tree import Tree
from lgrasp.learn.diffuser.features import mesh_centre
from lgrasp.object.model import ObjectModel
from lgrasp.object.sdf import SdfGrid, build_sdf, sample_sdf
from lgrasp.refine.surface import farthest_points

_NODES = 48**3  # of an object's grid
_PAD = 0.04  # [m] of a grid about the object: what is beyond is at least so far away
_NEAREST, _FARTHEST = -0.02, 0.04  # [m] distances that are told apart


class HeldObjects(NamedTuple):
    """Objects that N hands hold, up to S each."""

    object: torch.Tensor
    """Number of the grid, -1 none, (N, S) int64."""
    R: torch.Tensor
    """Rotation in the hand frame, (N, S, 3, 3)."""
    t: torch.Tensor
    """Position [m], (N, S, 3)."""


def coarse_grid(vertices: np.ndarray, faces: np.ndarray, *, closed: bool) -> SdfGrid:
    """Signed distances of a mesh about :func:`~lgrasp.learn.diffuser.features.mesh_centre`."""
    centred = np.asarray(vertices, float) - mesh_centre(vertices)
    grid = build_sdf(centred, np.asarray(faces, np.int32), closed=closed, max_cells=_NODES, pad=_PAD)
    return replace(grid, values=grid.values.astype(np.float32))


def coarse_grid_of_model(model: ObjectModel) -> SdfGrid:
    """The same of an object without faces, about its internal origin: its own distances, and beyond their grid how far
    off that is."""
    own, origin = model.grid, model.sdf_origin.astype(float)
    low, high = model.obstacle_points.min(0) - _PAD, model.obstacle_points.max(0) + _PAD
    cell = float(np.prod(high - low) / _NODES) ** (1 / 3)
    shape = np.ceil((high - low) / cell).astype(int) + 1
    nodes = low + cell * np.indices(tuple(shape)).reshape(3, -1).T
    beyond = np.linalg.norm(nodes - nodes.clip(origin, origin + (np.array(model.sdf.shape) - 1) * own.cell), axis=1)
    found = sample_sdf(own, nodes)
    values = np.where(beyond > 0, np.hypot(found.clip(0), beyond), found)
    return SdfGrid(values.reshape(shape).astype(np.float32), nodes[0].astype(np.float32), cell)


def sense_points(model: HandModel, each: int) -> torch.Tensor:
    """Points of a hand's surface: the body that each rides on, and its place in that body's frame [m], (P, 4).

    ``each`` of every body, and as many of what may touch there.
    """
    side, found = contact_surface(model), []
    for body in range(len(model.piece_first) - 1):
        first, end = (model.cluster_first[body : body + 2] * CLUSTER_SIZE).tolist()
        for points in (model.samples[first:end], side.points[side.body == body]):
            if len(points):
                chosen = points[farthest_points(points, each)]
                found.append(np.column_stack([np.full(each, body), chosen]))
    return torch.as_tensor(np.concatenate(found), dtype=torch.float32)


class Senses:
    """Distances in poses and postures that are still noisy: the network sees what its own estimate comes to.

    Args:
        points: of the hand (:func:`sense_points`), (P, 4).
        basis: points in the hand frame [m], (H, 3).
        grids: of all objects.
    """

    def __init__(
        self,
        tree: Tree,
        points: torch.Tensor,
        basis: torch.Tensor,
        grids: Sequence[SdfGrid],
        device: str | torch.device = "cpu",
    ) -> None:
        self._bodies = BodyKinematics(tree, device=device)
        self._body, self._points = points[:, 0].to(device).long(), points[:, 1:].to(device)
        self._basis, self._grids = basis.to(device), DistanceGrids(grids, device=device)

    @torch.no_grad()
    def __call__(
        self, R: torch.Tensor, t: torch.Tensor, q: torch.Tensor, object: torch.Tensor, held: HeldObjects
    ) -> torch.Tensor:
        """Distances in units of 2 cm, cut at -1 and 2: of the hand's points from the object and from what is held, and
        of the basis points from the object, (N, 2 P + H).

        Args:
            R, t: pose of the object to grasp in the hand frame, (N, 3, 3) and (N, 3) [m].
            q: joints [rad or m], (N, K).
            object: number of its grid, (N,) int64.
        """
        places = self._places(q)
        own = self._distance(torch.cat([places, self._basis.expand(len(q), -1, -1)], 1), R, t, object)
        other = self._from_held(places, held)
        return torch.cat([own, other], 1).clamp(_NEAREST, _FARTHEST) / -_NEAREST

    @torch.no_grad()
    def distances(
        self, R: torch.Tensor, t: torch.Tensor, q: torch.Tensor, object: torch.Tensor, held: HeldObjects
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Distances [m] of the hand's points from the object, and from what is held, (N, P); see :meth:`__call__`."""
        places = self._places(q)
        return self._distance(places, R, t, object), self._from_held(places, held)

    def _places(self, q: torch.Tensor) -> torch.Tensor:
        """The hand's points in the hand frame, (N, P, 3) [m]."""
        R_body, t_body = self._bodies(q)
        # by columns: as many products of small matrices take several times as long on a GPU
        x, y, z = R_body[:, self._body].unbind(-1)
        u, v, w = self._points[..., None].unbind(1)
        return x * u + y * v + z * w + t_body[:, self._body]

    def _from_held(self, places: torch.Tensor, held: HeldObjects) -> torch.Tensor:
        if not held.object.shape[1]:
            return torch.full(places.shape[:2], _FARTHEST, device=places.device)
        every = (places[:, None] - held.t[:, :, None]) @ held.R  # (N, S, P, 3) in the objects' frames
        x, y, z = every.unbind(-1)
        away = self._grids.value_within((x, y, z), held.object.clamp_min(0)[..., None])
        return torch.where(held.object[..., None] >= 0, away, _FARTHEST).amin(1)

    def _distance(self, x: torch.Tensor, R: torch.Tensor, t: torch.Tensor, object: torch.Tensor) -> torch.Tensor:
        """Signed distance [m] of points (N, n, 3) of the hand frame from one object for each row."""
        origin, within = -(t[:, None] @ R)[:, 0], []
        for k in range(3):  # by columns, as in _places
            at = origin[:, k, None]
            for component, share in zip(x.unbind(-1), R[:, :, k, None].unbind(1), strict=True):
                at = torch.addcmul(at, component, share)
            within.append(at)
        u, v, w = within
        return self._grids.value_within((u, v, w), object[:, None])
