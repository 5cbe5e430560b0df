"""Where fingers can hold something: contact points and normals of random postures vote for the centre of a ball."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.ndimage import convolve1d

from lgrasp.geometry.hulls import spread_directions
from lgrasp.hand.postures import Postures

_MIN_CELL = 0.010  # [m], more where fingers reach farther than hands do
_MAX_CELLS = 400_000
_BALL_RADII = (0.02, 0.025, 0.03)  # of the balls that are held [m]
_MIN_STATIC_DISTANCE = 0.016  # [m] of a ball's centre: a ball of 4 cm would cut static links
_PALM_WEIGHT = 0.02  # of a finger against the palm, where fingers could face each other
_FULL_VOTES = 4.0  # votes at which a finger counts as able to touch from a direction
_MIN_HALF_EDGE = 0.020  # half edges of the box [m]
_MAX_HALF_EDGE = 0.035  # [m]


class Touch(NamedTuple):
    """Contact points (n, 3) [m] and outward normals (n, 3) that one holder (finger or palm) can make, base frame."""

    name: str
    points: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True)
class Hold:
    """The best place to hold a ball of 4-6 cm: its centre, the region around it, and which holders oppose there."""

    score: float
    centre: np.ndarray  # (3,) [m]
    low: np.ndarray  # (3,)
    high: np.ndarray  # (3,)
    able: dict[str, float]  # holder -> how well it reaches a ball there, 0 to 1
    opposing: dict[tuple[str, str], float]  # pair of holders -> how well they face each other there, 0 to 1


def finger_touches(
    name: str, postures: Postures, group: int, body: int, points: np.ndarray, normals: np.ndarray, each: int = 8
) -> Touch:
    """Contact points of a body's allowed surface (body frame) at the postures at which its finger is clear."""
    rows = np.repeat(np.flatnonzero(postures.clear[:, group]), each)
    k = np.random.default_rng(body).integers(len(points), size=len(rows))
    return Touch(name, *postures.put(rows, body, points[k], normals[k]))


def still_touches(name: str, points: np.ndarray, normals: np.ndarray, count: int) -> Touch:
    """Contact points of a static surface, repeated to about ``count``."""
    rows = np.resize(np.arange(len(points)), max(count, len(points)))
    return Touch(name, points[rows], normals[rows])


def _smooth(votes: np.ndarray) -> np.ndarray:
    """Sums over neighbouring cells (weights 1/2, 1, 1/2 on each axis), votes (nx, ny, nz, b)."""
    for axis in range(3):
        votes = convolve1d(votes, [0.5, 1.0, 0.5], axis, mode="constant")
    return votes


def _balanced_threes(able: list[np.ndarray], axes: np.ndarray, free: np.ndarray) -> np.ndarray:
    """How well three fingers balance at each place (V,), summed over sets of three; ``able``: (V, b) per finger."""
    n = len(axes)
    i, j, k = np.meshgrid(*(np.arange(n),) * 3, indexing="ij")
    # directions balance when each one's share of the force is positive and the rest is within friction
    normal = np.cross(axes[i], axes[j])
    flat = np.abs((normal * axes[k]).sum(-1)) < 0.35
    spread = (np.abs(axes[i] + axes[j] + axes[k]) ** 2).sum(-1) < 0.5
    i, j, k = (x[flat & spread] for x in (i, j, k))
    out = np.zeros(len(free), np.float32)
    rows = np.flatnonzero(free & (np.sum([a.max(1) > 0.05 for a in able], 0) >= 3))
    for part in np.array_split(rows, max(1, len(rows) * len(i) // 10_000_000)):
        for a, b, c in combinations(able, 3):
            least = np.minimum(np.minimum(a[part][:, i], b[part][:, j]), c[part][:, k])
            out[part] += least.max(1) + 10.0 * least.mean(1)
    return out


def best_hold(touches: Iterable[Touch], static_depth: Callable[[np.ndarray], np.ndarray]) -> Hold | None:
    """Where two or more holders face each other across a ball; None when no two ever do.

    Args:
        static_depth: points (n, 3) [m] -> lower bound of their distance to the static links (n,) [m].
    """
    touches = [t for t in touches if len(t.points)]
    if len(touches) < 2:
        return None
    centres = [np.vstack([t.points + r * t.normals for r in _BALL_RADII]) for t in touches]
    low, high = np.min([c.min(0) for c in centres], 0), np.max([c.max(0) for c in centres], 0)
    size = max(_MIN_CELL, float(np.prod(high - low) / _MAX_CELLS) ** (1 / 3))
    shape = np.floor((high - low) / size).astype(int) + 1
    axes = spread_directions(32)
    alike = (axes @ axes.T > 0.85).astype(np.float32)
    able = []
    for t, c in zip(touches, centres, strict=True):
        cell = np.ravel_multi_index(tuple(np.floor((c - low) / size).astype(int).T), tuple(shape))
        side = np.tile(np.argmax(t.normals @ axes.T, 1), len(_BALL_RADII))
        votes = np.bincount(cell * len(axes) + side, minlength=int(shape.prod()) * len(axes)).astype(np.float32)
        # neighbouring directions count as well
        votes = _smooth(votes.reshape(*shape, len(axes))).reshape(-1, len(axes)) @ alike
        able.append(np.minimum(votes * (20_000 / len(c)) / _FULL_VOTES / 8, 1.0))
    places = low + (np.stack(np.unravel_index(np.arange(shape.prod()), tuple(shape)), -1) + 0.5) * size
    free = static_depth(places) >= _MIN_STATIC_DISTANCE
    opposite = axes @ axes.T < -0.82
    partner = [np.stack([a[:, opposite[b]].max(1) for b in range(len(axes))], 1) for a in able]
    fingers = [i for i, t in enumerate(touches) if t.name != "palm"]
    pairs = {}
    score = np.zeros(len(places), np.float32)
    for i, last in enumerate(touches):
        score += 0.05 * able[i].max(1)
        for j, first in enumerate(touches[:i]):
            facing = np.minimum(able[i], partner[j])
            # one way to oppose is needed, several make it robust
            pairs[first.name, last.name] = value = facing.max(1) + 0.1 * facing.sum(1)
            with_palm = "palm" in (first.name, last.name)
            score += value * (_PALM_WEIGHT if with_palm and len(fingers) > 1 else 1.0)
    faced = np.max(list(pairs.values()), axis=0)
    if len(fingers) > 2:
        three = _balanced_threes([able[i] for i in fingers], axes, free)
        score, faced = 0.3 * score + three, np.maximum(faced, three)
    score[~free] = 0.0
    score[faced < 0.05] = 0.0
    if score.max() <= 0.0:
        return None
    grid = _smooth(score.reshape(*shape, 1)).ravel() * (score > 0)
    best = int(np.argmax(grid))
    near = (grid > 0.6 * grid[best]) & (np.linalg.norm(places - places[best], axis=1) < 0.05)
    weight = grid[near] / grid[near].sum()
    centre = weight @ places[near]
    half = np.clip(1.3 * np.sqrt(weight @ (places[near] - centre) ** 2), _MIN_HALF_EDGE, _MAX_HALF_EDGE)
    strength = {k: float(min(1.0, v[near].max())) for k, v in pairs.items()}
    reached = {t.name: float(a[near].max()) for t, a in zip(touches, able, strict=True)}
    return Hold(float(grid[best]), centre, centre - half, centre + half, reached, strength)
