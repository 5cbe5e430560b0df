"""Rigid solids of hands and objects: points of their surface, and grids of their distance."""

from dataclasses import dataclass

import numpy as np

from lgrasp.geometry.clusters import CLUSTER_SIZE, bounding_spheres, cluster_order, evenly
from lgrasp.hand.model import HandModel
from lgrasp.hand.piece import Piece
from lgrasp.object.model import ObjectModel
from lgrasp.object.sdf import SdfGrid

RUN = 16
"""Surface points are in compact runs of this many."""

_CELL_SIZE = 0.001  # [m]
_MAX_NODES = 120_000
_MAX_STILL_SHARE = 0.25  # of a hand's points, on links that do not move
_PAD_CELLS = 2.0
_BURIED_DEPTH = 0.001  # [m]
_MAX_DISTANCES = 1 << 22  # most point-plane distances held at once


@dataclass(frozen=True)
class PointSolid:
    """A rigid solid in its own frame; lengths in metres."""

    points: np.ndarray
    """On its surface, in compact runs of RUN, (n, 3)."""
    run_ball: np.ndarray
    """Ball around each run: centre and radius, (n / RUN, 4)."""
    ball: np.ndarray
    """Ball around the solid, (4,)."""
    grid: SdfGrid


@dataclass(frozen=True)
class HandPoints:
    """Links of a hand that have collision geometry, each in the frame of the body that it rides on."""

    links: np.ndarray
    """Index in ``link_names``, (L,)."""
    body: np.ndarray
    """Body of each, (L,)."""
    solids: tuple[PointSolid, ...]
    pairs: np.ndarray
    """Pairs of them that must stay apart: not joined by a joint, not touching always, (P, 2)."""


def hand_solids(model: HandModel, count: int) -> HandPoints:
    """The links of a hand as solids, with about ``count`` surface points together (more on small links).

    A link is the union of its convex pieces, which stand for its collision geometry in all of lgrasp. They are kept
    with the model.
    """
    made = vars(model).setdefault("_solids", {})  # as cached_property does
    if count not in made:
        made[count] = _hand_solids(model, count)
    return made[count]


def _hand_solids(model: HandModel, count: int) -> HandPoints:
    pieces = [model.piece(i) for i in range(len(model.piece_body))]
    members = {int(k): np.flatnonzero(model.piece_link == k) for k in np.unique(model.piece_link)}
    static = int(model.cluster_first[1]) * CLUSTER_SIZE
    still = min(count * static / len(model.samples), count * _MAX_STILL_SHARE)
    share = {True: still / max(static, 1), False: (count - still) / max(len(model.samples) - static, 1)}
    solids = []
    for own in members.values():
        samples = _link_samples(model, pieces, own)
        chosen = [pieces[i] for i in own]
        part = share[bool(model.piece_body[own[0]] == 0)]
        solids.append(_solid(evenly(samples, max(round(part * len(samples)), RUN)), _ball(chosen), _grid(chosen)))
    links = np.array(list(members))  # sorted
    pairs = np.unique(np.sort(model.piece_link[model.pairs], axis=1), axis=0)
    return HandPoints(links, model.tree.link_body[links], tuple(solids), np.searchsorted(links, pairs))


def object_solid(model: ObjectModel, count: int) -> PointSolid:
    """An object in its internal frame, with ``count`` surface points (rounded up to whole runs)."""
    points = model.obstacle_points
    ball = np.array([0.0, 0.0, 0.0, np.linalg.norm(points, axis=1).max()])  # the centre of the bounding box
    return _solid(evenly(points, max(count, RUN)), ball, model.grid)


def _solid(points: np.ndarray, ball: np.ndarray, grid: SdfGrid) -> PointSolid:
    points = np.resize(points, (-(-len(points) // RUN) * RUN, 3))  # the last run is filled with repeats
    points = points[cluster_order(points, size=RUN)].astype(np.float32)
    centre, radius = bounding_spheres(points, size=RUN)
    return PointSolid(points, np.column_stack([centre, radius]), ball.astype(np.float32), grid)


def _link_samples(model: HandModel, pieces: list[Piece], own: np.ndarray) -> np.ndarray:
    """Surface samples of the link with pieces ``own``: those of its body nearest to the surface of one of them.

    Samples inside another piece of the link are left out: two of its pieces meet there.
    """
    body = int(model.piece_body[own[0]])
    first, end = model.cluster_first[body] * CLUSTER_SIZE, model.cluster_first[body + 1] * CLUSTER_SIZE
    samples = model.samples[first:end]
    same = np.flatnonzero(model.piece_body == body)
    depth = np.array([pieces[i].depth(samples) for i in same])  # (pieces, n)
    nearest = np.abs(depth).argmin(0)
    np.put_along_axis(depth, nearest[None], np.inf, 0)
    buried = (depth[np.isin(same, own)] < -_BURIED_DEPTH).any(0)
    return samples[np.isin(same[nearest], own) & ~buried]


def _ball(pieces: list[Piece]) -> np.ndarray:
    """Ball around pieces, (4,) [m]."""
    vertices = np.concatenate([p.vertices for p in pieces])
    centre = 0.5 * (vertices.min(0) + vertices.max(0))
    return np.append(centre, max(np.linalg.norm(p.vertices - centre, axis=1).max() + p.radius for p in pieces))


def _grid(pieces: list[Piece]) -> SdfGrid:
    """Signed distances of the union of convex pieces, a lower bound outside."""
    low = np.min([p.vertices.min(0) - p.radius for p in pieces], 0)
    high = np.max([p.vertices.max(0) + p.radius for p in pieces], 0)
    cell = max(_CELL_SIZE, float(np.prod(high - low + 4 * _CELL_SIZE) / _MAX_NODES) ** (1 / 3))
    origin = low - _PAD_CELLS * cell
    shape = np.ceil((high - low) / cell + 2 * _PAD_CELLS).astype(int) + 1
    nodes = origin + cell * np.indices(shape).reshape(3, -1).T
    most = max(1, _MAX_DISTANCES // max(1, *(len(piece.planes) for piece in pieces)))
    parts = np.array_split(nodes, -(-len(nodes) // most))
    values = np.concatenate([np.min([piece.depth(part) for piece in pieces], 0) for part in parts])
    return SdfGrid(values.reshape(shape).astype(np.float32), origin.astype(np.float32), cell)
