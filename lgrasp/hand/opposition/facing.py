"""Whether two surfaces of a hand press towards each other, and how far apart they are then."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lgrasp.hand.model import HandModel
from lgrasp.hand.opposition.spaces import Space
from lgrasp.hand.postures import SAMPLED_POSTURES, Postures, sample_bodies
from lgrasp.hand.surface import ContactLink

_MIN_FACING_COSINE = np.cos(np.radians(35.0))  # of each hand normal to the line between the two, at least
_MIN_PALM_COSINE = np.cos(np.radians(16.0))  # of the palm's, which no finger can turn
_WIDTH_RANGE = (0.002, 0.20)  # [m]
_PAIRS_DRAWN = 400_000  # pairs of points that are looked at
_MIN_FACING_PAIRS = 100  # of them that must face each other for a space to hold anything
_MIN_PRESSED_SHARE = 0.3  # share of those that a joint must move towards each other
_MIN_SPEED = 5.0e-3  # [m/rad] of a contact that a joint moves


@dataclass(frozen=True)
class Opening:
    """Distances at which the two sides of a space face each other."""

    share: float  # of pairs of points, each at any posture of its finger, that do
    pressed: float  # share of these that a joint of the space moves towards each other
    low: float  # [m], 1 in 1000 is nearer; NaN when the sides hardly ever face each other
    high: float  # [m], 1 in 1000 is farther

    @property
    def problem(self) -> str:
        """Why the space can hold nothing; empty when it can."""
        if not np.isfinite(self.low):
            return "its sides never face each other"
        return "" if self.pressed > _MIN_PRESSED_SHARE else "no joint of it moves its sides towards each other"


def opposed(
    p: np.ndarray, n: np.ndarray, q: np.ndarray, m: np.ndarray, *, still: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Which pairs of contacts press towards each other, (N,) bool, and their distances (N,) [m].

    Args:
        p, q: points of the pairs (N, 3) [m]. n, m: their outward unit normals (N, 3).
        still: the second ones are on a static surface.
    """
    line = q - p
    x, y, z = line.T
    width = np.sqrt(x * x + y * y + z * z)
    good = np.einsum("nd,nd->n", line, n) > _MIN_FACING_COSINE * width
    good &= (width > _WIDTH_RANGE[0]) & (width < _WIDTH_RANGE[1])
    left = np.flatnonzero(good)  # a tenth
    along = np.einsum("nd,nd->n", line.take(left, 0), m.take(left, 0))
    good[left] = along < -(_MIN_PALM_COSINE if still else _MIN_FACING_COSINE) * width[left]
    return good, width


def space_postures(model: HandModel) -> Postures:
    """Random postures of a hand; row r has the shared joints at setting r modulo the number of settings."""
    tree = model.tree
    q = model.random_postures(SAMPLED_POSTURES)
    shared = np.isin(tree.joint_names, tree.shared_names)
    q[:, shared] = np.resize(tree.settings[:, shared], (SAMPLED_POSTURES, int(shared.sum())))
    return sample_bodies(model, q)


def space_opening(
    model: HandModel, postures: Postures, space: Space, sides: tuple[Sequence[ContactLink], Sequence[ContactLink]]
) -> Opening:
    """How far the two sides of a space open, by random pairs of postures of their fingers, shared joints alike.

    Args:
        postures: see :func:`space_postures`.
    """
    if not all(sides):
        return Opening(0.0, 0.0, np.nan, np.nan)
    first, second = sorted(sides, key=lambda side: side[0].group)  # the palm last
    still = second[0].group == model.groups
    rng = np.random.default_rng(1)
    settings = len(model.tree.settings)
    count = _PAIRS_DRAWN // settings
    widths, pressed = [np.zeros(0)], 0
    for setting in range(settings):
        ends = [_contacts(model, postures, side, setting, settings, count, rng) for side in (first, second)]
        if any(len(end.row) == 0 for end in ends):
            continue
        good, width = opposed(ends[0].p, ends[0].n, ends[1].p, ends[1].n, still=still)
        a, b = (end.taken(good) for end in ends)
        line = (b.p - a.p) / width[good][:, None]
        moves = [_moves_along(model, postures, space.joints, end, line) for end in (a, b)]
        widths.append(width[good])
        pressed += int((moves[0] | moves[1]).sum())
    width = np.concatenate(widths)
    low, high = np.percentile(width, [0.1, 99.9]) if len(width) >= _MIN_FACING_PAIRS else (np.nan, np.nan)
    return Opening(len(width) / (count * settings), pressed / max(len(width), 1), float(low), float(high))


class _Contacts(NamedTuple):
    """Contacts of a side at random postures, base frame."""

    row: np.ndarray  # (n,) posture
    body: np.ndarray  # (n,)
    p: np.ndarray  # (n, 3) [m]
    n: np.ndarray  # (n, 3)

    def taken(self, mask: np.ndarray) -> "_Contacts":
        return _Contacts(*(a[mask] for a in self))


def _contacts(
    model: HandModel,
    postures: Postures,
    side: Sequence[ContactLink],
    setting: int,
    settings: int,
    count: int,
    rng: np.random.Generator,
) -> _Contacts:
    """Random contacts of a side where its finger is clear of the palm; none where it never is."""
    group = side[0].group
    points, normals = (np.concatenate([getattr(link, key) for link in side]) for key in ("points", "normals"))
    clear = np.arange(len(postures.q)) % settings == setting
    if group < model.groups:
        clear &= postures.clear[:, group]
    rows = np.flatnonzero(clear)
    count = count if len(rows) else 0
    k = rng.integers(len(points), size=count)
    row = rows[rng.integers(max(len(rows), 1), size=count)]
    body = np.repeat([model.tree.body_of(link.link) for link in side], [len(link.points) for link in side])[k]
    return _Contacts(row, body, *postures.put(row, body, points.take(k, 0), normals.take(k, 0)))


def _moves_along(
    model: HandModel, postures: Postures, joints: np.ndarray, end: _Contacts, line: np.ndarray
) -> np.ndarray:
    """True if a joint moves a contact within 60 degrees of a unit vector ``line`` (n, 3) or against it, (n,)."""
    tree = model.tree
    velocity = np.zeros((model.dofs, len(end.row), 3))
    for body in np.unique(end.body[end.body > 0]):
        mine = end.body == body
        row, p = end.row[mine], end.p[mine]
        for up in reversed(tree.path(int(body))):
            axis = postures.R[row, up] @ tree.joint_axis[up - 1].astype(float)
            moved = axis if tree.joint_prismatic[up - 1] else np.cross(axis, p - postures.t[row, up])
            velocity[tree.joint_column[up - 1], mine] += tree.joint_mult[up - 1] * moved
    speed = np.linalg.norm(velocity[joints], axis=2)
    along = np.abs(np.einsum("jnd,nd->jn", velocity[joints], line))
    return ((along > 0.5 * speed) & (speed > _MIN_SPEED)).any(0)
