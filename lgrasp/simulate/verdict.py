"""Findings on one grasp, the rules by which its simulation ends and holds, and the columns of its verdict.

The same on the CPU as on a GPU; a shard has the columns as physics/PROTOCOL_NAME.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np

from lgrasp.simulate.protocol import Protocol

CHUNK = 0.05
"""[s] between looks at the objects."""
LONG_CHUNK = 0.1
"""The same in PhysX, where objects stand still for longer before they creep, and on the way up [s]."""
WILD = 1.0e3
"""[m/s or rad/s]: no hand and no object is so fast, the simulation has diverged."""
AXES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
"""Directions of the load in the hand's base frame."""

_REST = (0.01, 0.1)  # [m/s], [rad/s]: slower is at rest
_LEAST_IS_WORST = ("holds", "stays", "settled", "contact_at_q", "contact_at_grasp")
_LOST_DISTANCE = 0.5  # [m]: an object that got so far from its start will not touch the hand again


class Verdict(NamedTuple):
    """Findings on one grasp of O objects; COLUMNS and OBJECT_COLUMNS say what the numbers mean."""

    holds: bool
    displacement: np.ndarray  # (6,) [m]
    rotation: np.ndarray  # (6,) [rad]
    contact_at_q: int
    pregrasp_penetration: float
    settled: bool
    diverged: bool
    directions: np.ndarray = np.full(6, -1, np.int8)
    slip: float = np.nan
    contact_at_grasp: int = -1
    stays: bool = False
    penetration: float = np.nan
    object_touches: np.ndarray = np.full(1, -1, np.int8)  # (O,)
    object_displacement: np.ndarray = np.full(1, np.nan)  # (O,) [m]
    object_rotation: np.ndarray = np.full(1, np.nan)  # (O,) [rad]
    share: float = np.nan  # NaN: nothing was drawn
    pushed: float = np.nan  # [m]; NaN: not lifted
    on_table: bool = False


class Look(NamedTuple):
    """A row before it is simulated, or any number of rows at once (...)."""

    points: np.ndarray
    """Contact points at q in the frames of their links (O, C, 3) [m]."""
    contact_at_q: np.ndarray
    """Links within 1 mm of each object at q (O,)."""
    depth: Any
    """Deepest penetration at the start, links with links included [m]."""
    object_depth: Any
    """Deepest penetration of any object at the start [m]."""
    qpos: np.ndarray
    """MuJoCo's state at the start."""


class Closed(NamedTuple):
    """The closed hand, or any number of them at once (...)."""

    contacts: Any
    """Links on the object that the fewest touch, before the squeeze."""
    slip: Any
    settled: Any
    moved: np.ndarray
    """Displacement [m] and rotation [rad] of each object at worst (O, 2); NaN: not run, or diverged."""
    depth: Any
    """Deepest penetration of any object until now [m]."""


class Pulls(NamedTuple):
    """The six directions of one grasp, or of any number of grasps at once (...)."""

    held: np.ndarray
    """1 held, 0 lost, -1 not run, (..., 6) i8."""
    moved: np.ndarray
    """Displacement [m] and rotation [rad] of each object at worst (..., 6, O, 2); NaN: not run, or diverged."""
    touches: np.ndarray
    """Each object touches the hand when the direction ends (..., 6, O)."""
    depth: np.ndarray
    """Deepest penetration of any object [m] (..., 6), at least that of closing."""

    @classmethod
    def of(cls, *shape: int) -> Self:
        """None run yet; shape (..., O)."""
        *many, objects = shape
        held, touches = np.full((*many, 6), -1, np.int8), np.zeros((*many, 6, objects), bool)
        return cls(held, np.full((*many, 6, objects, 2), np.nan), touches, np.zeros((*many, 6)))


class Bounds:
    """When a direction is over, and whether it is held.

    Arrays have any leading axes (...); ``moved`` holds displacement [m] and rotation [rad] of O objects (..., O, 2).
    """

    def __init__(self, protocol: Protocol) -> None:
        self.most = np.array([protocol.most_displacement, np.radians(protocol.most_rotation)])
        self._by_contact, self._deepest = protocol.success == "touches", protocol.most_penetration
        self._end = np.array([_LOST_DISTANCE, np.inf]) if self._by_contact else self.most

    def lost(self, moved: np.ndarray) -> Any:
        """True if an object is so far away that the grasp is lost (...)."""
        return (moved > self._end).any((-2, -1))

    def held(self, moved: np.ndarray, touches: np.ndarray, depth: Any) -> Any:
        """True if a direction that ended in this state is held (...).

        Args:
            moved: at worst.
            touches: each object touches the hand (..., O).
            depth: deepest penetration of any object until now [m] (...).
        """
        within = ~self.lost(moved)
        return within & touches.all(-1) & (depth < self._deepest) if self._by_contact else within

    def stays(self, moved: np.ndarray) -> Any:
        """True if every object stays within the bounds (...). False if it diverged."""
        return (moved <= self.most).all((-2, -1))

    def near(self, before: np.ndarray, now: np.ndarray, chunks: Any) -> Any:
        """True if objects at four times their speed of the last chunk stay in half their bounds to the end (...).

        Args:
            before, now: ``moved`` a chunk ago and now.
            chunks: left (...).
        """
        ahead = now + 4 * np.abs(now - before) * np.asarray(chunks)[..., None, None]
        return (ahead < 0.5 * self.most).all((-2, -1))


def chunk_of(protocol: Protocol) -> float:
    """Time between looks [s]."""
    return LONG_CHUNK if protocol.engine != "mujoco" or protocol.lift else CHUNK


def conclude(bounds: Bounds, look: Look, closed: Closed, pulls: Pulls, diverged: Any) -> Verdict:
    """The verdict of one grasp, or of any number of grasps at once: then everything, ``diverged`` and the verdict
    included, has leading axes."""
    run = pulls.held >= 0
    far = pulls.moved.max(-2)  # (..., 6, 2)
    ever = np.any(run, axis=-1, keepdims=True)
    of_runs = np.where(run[..., None, None], pulls.moved, -np.inf).max(-3)
    worst = np.where(ever[..., None], of_runs, closed.moved)  # (..., O, 2)
    touches = np.where(ever, (pulls.touches | ~run[..., None]).all(-2), -1)
    return Verdict(
        holds=(pulls.held == 1).all(-1),
        directions=pulls.held,
        displacement=far[..., 0],
        rotation=far[..., 1],
        slip=closed.slip,
        contact_at_q=look.contact_at_q.min(-1),
        contact_at_grasp=closed.contacts,
        pregrasp_penetration=look.depth,
        settled=closed.settled,
        diverged=diverged,
        stays=run.all(-1) & bounds.stays(pulls.moved).all(-1),
        penetration=np.maximum(closed.depth, pulls.depth.max(-1)),
        object_touches=touches.astype(np.int8),
        object_displacement=worst[..., 0],
        object_rotation=worst[..., 1],
    )


def worst(draws: Sequence[Verdict]) -> Verdict:
    """The verdict of one grasp from those of its draws: the share that holds, and the worst of everything else."""
    every = {name: np.array([getattr(verdict, name) for verdict in draws]) for name in Verdict._fields}
    found: dict[str, Any] = {name: np.fmax.reduce(values) for name, values in every.items()}
    found |= {name: every[name].min(0) for name in _LEAST_IS_WORST}
    for name in ("directions", "object_touches"):  # lost in one draw is lost; -1: not run in one
        found[name] = np.where((every[name] == 0).any(0), 0, every[name].min(0)).astype(np.int8)
    found["share"] = every["holds"].mean()
    return Verdict(**found)


def moved(pose: np.ndarray, home: np.ndarray) -> np.ndarray:
    """How far objects are from where they started: displacement [m] and rotation [rad], (..., O, 2), by poses of their
    centres of mass now and at the start (..., O, 7)."""
    now, start = np.asarray(pose, float), np.asarray(home, float)
    a, b, shift = now[..., 3:], start[..., 3:], now[..., :3] - start[..., :3]
    cosine = np.abs(np.vecdot(a, b)) / np.maximum(np.sqrt(np.vecdot(a, a) * np.vecdot(b, b)), 1e-12)
    found = np.empty((*shift.shape[:-1], 2))
    found[..., 0] = np.sqrt(np.vecdot(shift, shift))
    found[..., 1] = 2 * np.arccos(np.minimum(cosine, 1.0))
    return found


def at_rest(velocity: np.ndarray) -> np.ndarray:
    """Whether objects with linear and angular velocities (..., O, 6) are all at rest (...)."""
    speed = np.linalg.norm(velocity.reshape(*velocity.shape[:-1], 2, 3), axis=-1)
    return (speed < _REST).all((-2, -1))


COLUMNS: dict[str, str] = {
    "holds": "bool [N]: success in all six directions",
    "directions": "int8 [N, 6]: +x -x +y -y +z -z of the hand base frame; 1 held, 0 lost, -1 not run",
    "displacement": "float32 [N, 6]: farthest that an object's centre of mass got from its start [m]; NaN: not run or "
    "diverged",
    "rotation": "float32 [N, 6]: farthest that an object turned from its start [rad]; NaN as above",
    "slip": "float32 [N]: at the end of closing, how far a link's point that touches a contact point at q is from that "
    "point of the object, largest of the grasp's contacts [m]; NaN: no contacts, or an object was lost before",
    "contact_at_q": "int16 [N]: links within 1 mm of the object that has fewest, at exactly q; geometry, nothing is "
    "simulated",
    "contact_at_grasp": "int16 [N]: links that touch the object that has fewest, when the hand has come to rest with "
    "targets q, before any squeeze",
    "pregrasp_penetration": "float32 [N]: deepest penetration at the start, of an object or of links [m]",
    "settled": "bool [N]: objects at rest when the pull begins (below 1 cm/s and 0.1 rad/s)",
    "diverged": "bool [N]: the simulation ran away; counts as lost",
}
"""Name (without the protocol's) -> type, shape and what it says."""

OBJECT_COLUMNS: dict[str, str] = {
    "stays": "bool [N]: every object stays within the bounds in all six directions",
    "penetration": "float32 [N]: deepest penetration of any object, in the hand or in another object, at the start or "
    "at any time [m]",
    "object_touches": "int8 [N, O]: 1 touches the hand at the end of every direction run, 0 does not, -1 absent or not "
    "run",
    "object_displacement": "float32 [N, O]: farthest that its centre of mass got from its start in any direction [m]; "
    "NaN: absent, not run or diverged",
    "object_rotation": "float32 [N, O]: farthest that it turned from its start [rad]; NaN as above",
}
"""The same for what is written where rows may have several objects, and by protocols whose success is to touch."""

DRAWN_COLUMNS: dict[str, str] = {
    "share": "float32 [N]: share of the draws in which the grasp holds",
}
"""The same for what is written by protocols with draws, whose other columns are the worst of all draws."""

LIFT_COLUMNS: dict[str, str] = {
    "holds": "bool [N]: the object stayed in the hand and touches no table at the end",
    "displacement": "float32 [N]: farthest that its centre of mass got from where it was in the hand when that began "
    "to rise [m]; NaN: not run or diverged",
    "rotation": "float32 [N]: farthest that it turned in the hand since then [rad]; NaN as above",
    "pushed": "float32 [N]: how far it was moved before the hand closed [m]; NaN as above",
    "on_table": "bool [N]: it touches the table at the end, or when it is lost",
    "contact_at_q": COLUMNS["contact_at_q"],
    "pregrasp_penetration": COLUMNS["pregrasp_penetration"],
    "settled": "bool [N]: the object at rest when the hand begins to rise (below 1 cm/s and 0.1 rad/s)",
    "diverged": COLUMNS["diverged"],
}
"""What is written by protocols that lift off a table in place of all of these."""

FREE_LIFT_COLUMNS: dict[str, str] = LIFT_COLUMNS | {
    "holds": "bool [N]: the object stayed in the hand",
    "displacement": "float32 [N]: farthest that its centre of mass got from its start, seen from the hand [m]; NaN: "
    "not run or diverged",
    "rotation": "float32 [N]: farthest that it turned from its start, likewise [rad]; NaN as above",
}
del FREE_LIFT_COLUMNS["pushed"], FREE_LIFT_COLUMNS["on_table"]
"""The same without a table."""


def stack_verdicts(protocol: Protocol, verdicts: Sequence[Verdict], slots: np.ndarray) -> dict[str, np.ndarray]:
    """Columns NAME_... of one protocol from the verdicts of its rows.

    Args:
        slots: (N, O) which of its verdict's objects is in each slot of a row, -1 absent.
    """
    several = slots.shape[1] > 1 or protocol.success == "touches"
    columns = COLUMNS | (OBJECT_COLUMNS if several else {}) | (DRAWN_COLUMNS if protocol.draws else {})
    if protocol.lift:
        columns = LIFT_COLUMNS if protocol.table else FREE_LIFT_COLUMNS
    out = {}
    for column, text in columns.items():
        values = [getattr(verdict, column) for verdict in verdicts]
        dtype = np.dtype(text.partition(" ")[0])
        if "[N, O]" in text:
            stacked = np.full(slots.shape, -1 if dtype == np.int8 else np.nan, dtype)
            for row, found, slot in zip(stacked, values, slots, strict=True):
                row[slot >= 0] = found[slot[slot >= 0]]
        else:
            stacked = np.array(values, dtype).reshape((len(verdicts), 6) if "[N, 6]" in text else len(verdicts))
        out[f"{protocol.name}_{column}"] = stacked
    return out
