"""Points of a hand's surface for the local search, with weights: palmar points pull, all of them are kept out."""

from dataclasses import dataclass

import numpy as np

from lgrasp.geometry.clusters import CLUSTER_SIZE
from lgrasp.hand.contact_surface import ContactSurface, contact_surface
from lgrasp.hand.model import HandModel
from lgrasp.hand.surface_visibility import last_bodies
from lgrasp.refine.params import DISTAL, OTHER

BLOCK = 24
"""Points are in blocks of this many, each on one body."""

LINK_POINTS = 1024
"""Points of the surfaces of all links together, where links are solids (:func:`hand_solids`)."""

_PROBES_PER_LINK = 32
_PALMAR_PER_BLOCK = 16  # of a block
_AREA_BLOCKS = 4  # most blocks of one body
_PER_BLOCK = 500  # surface samples of a body to a block


@dataclass(frozen=True)
class HandSurface:
    """Blocks of surface points, each riding on one body; a hand of L blocks."""

    body: np.ndarray
    """Body of each block, (L,)."""
    points: np.ndarray
    """In the frame of that body [m], (L, BLOCK, 3)."""
    normals: np.ndarray
    """Outward unit normals, zero where the weight is zero, (L, BLOCK, 3)."""
    weight: np.ndarray
    """How strongly each point is drawn to the object, 0 for points that are only kept out, (L, BLOCK)."""


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of ``count`` of points (n, 3), each the farthest from those before (all and repeats when there are
    fewer)."""
    chosen, gap = [0], np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        away = points - points[chosen[-1]]
        np.minimum(gap, np.einsum("ij,ij->i", away, away), out=gap)
        chosen.append(int(gap.argmax()))
    return np.resize(chosen, count)


def link_probes(points: np.ndarray) -> np.ndarray:
    """Those of a link's surface points that other links are probed with, (32, 3) [m]."""
    return points[farthest_points(points, _PROBES_PER_LINK)]


def hand_surface(
    model: HandModel, palmar: ContactSurface | None = None, *, distal: float = DISTAL, other: float = OTHER
) -> HandSurface:
    """Surface of a hand for the local search.

    Args:
        palmar: default: :func:`contact_surface`.
        distal, other: weight of palmar points on the last links of fingers, and elsewhere.
    """
    side = palmar or contact_surface(model)
    last = last_bodies(model)
    bodies, blocks = [], []
    for b in range(len(model.piece_first) - 1):
        first, end = (model.cluster_first[b : b + 2] * CLUSTER_SIZE).tolist()
        samples, own = model.samples[first:end], np.flatnonzero(side.body == b)
        if len(samples) == 0:
            continue
        count = int(np.clip(len(samples) // _PER_BLOCK, 1, _AREA_BLOCKS))
        drawn = _PALMAR_PER_BLOCK * count if len(own) else 0
        rest = samples[farthest_points(samples, BLOCK * count - drawn)]
        weight = np.zeros((count, BLOCK))
        p, n = np.zeros((count, BLOCK, 3)), np.zeros((count, BLOCK, 3))
        if drawn:
            chosen = own[farthest_points(side.points[own], drawn)]
            p[:, :_PALMAR_PER_BLOCK] = side.points[chosen].reshape(count, -1, 3)
            n[:, :_PALMAR_PER_BLOCK] = side.normals[chosen].reshape(count, -1, 3)
            weight[:, :_PALMAR_PER_BLOCK] = distal if b in last else other
            p[:, _PALMAR_PER_BLOCK:] = rest.reshape(count, -1, 3)
        else:
            p[:] = rest.reshape(count, -1, 3)
        bodies += [b] * count
        blocks.append((p, n, weight))
    p, n, weight = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    return HandSurface(np.array(bodies), p, n, weight)
