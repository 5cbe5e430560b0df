"""Hands moved until they pass the checks: a local search, evaluated on its way, restarted nearby if it fails."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from lgrasp.geometry.poses import device_inverse
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.check import check_grasps
from lgrasp.grasp.find_contacts import find_contacts
from lgrasp.grasp.outcomes import Outcome
from lgrasp.grasp.tables import GraspTable, choose_grasps, join_rows
from lgrasp.hand.arrays import HandArrays
from lgrasp.object.arrays import ObjectArrays
from lgrasp.refine.descent import Descent
from lgrasp.refine.hands import Hands
from lgrasp.runtime.cores import cores

_ROUNDS_PER_LOOK = 4  # matching rounds between two looks
_START_SHIFT, _START_BEND = 0.003, 0.03  # spread of further starts [m], [rad or m]
_CPU_ROWS = 32  # of one thread


def improve(
    search: Descent,
    hand: HandArrays,
    obj: ObjectArrays,
    pose: np.ndarray,
    q: np.ndarray,
    bounds: GraspBounds,
    *,
    tries: np.ndarray,
    resting: np.ndarray | None = None,
    index: np.ndarray,
) -> tuple[GraspTable, np.ndarray]:
    """Hands at their best: of the postures that pass the checks the one that resists loads best.

    The search is looked at after every few matching rounds. A hand that has passed nowhere begins again, near where it
    was and with twice the rounds. One that never passes is given as its first search left it. What becomes of a hand
    does not depend on the others.

    Args:
        pose: T_hand_object of the object's internal frame, x y z [m] qx qy qz qw, (n, 7).
        q: joint positions within their limits [rad or m], (n, K).
        tries: most searches of each hand, (n,).
        resting: as of :func:`~lgrasp.grasp.check.check_grasps`.
        index: candidate of each row.

    Returns:
        Rows in the order given, and their outcomes (:class:`~lgrasp.grasp.outcomes.Outcome`), (n,).
    """
    parts = [slice(first, first + _CPU_ROWS) for first in range(0, len(q), _CPU_ROWS)]
    if search.device != "cpu" or len(parts) < 2:
        return _improved(search, hand, obj, pose, q, bounds, tries, resting, index)

    def part(p: slice) -> tuple[GraspTable, np.ndarray]:
        plane = None if resting is None else resting[p]
        return _improved(search, hand, obj, pose[p], q[p], bounds, tries[p], plane, index[p])

    with ThreadPoolExecutor(cores()) as pool:
        tables, outcomes = zip(*pool.map(part, parts), strict=True)
    return join_rows(list(tables)), np.concatenate(outcomes)


def _improved(
    search: Descent,
    hand: HandArrays,
    obj: ObjectArrays,
    pose: np.ndarray,
    q: np.ndarray,
    bounds: GraspBounds,
    tries: np.ndarray,
    resting: np.ndarray | None,
    index: np.ndarray,
) -> tuple[GraspTable, np.ndarray]:
    table: GraspTable | None = None
    outcome = np.full(len(q), Outcome.CONTACT)
    for number in range(int(tries.max(initial=1))):
        rows = np.flatnonzero((outcome != Outcome.KEPT) & (tries > number)) if number else np.arange(len(q))
        if not len(rows):
            break
        start = _start(search, hand, pose[rows], q[rows], number)
        for back, joints in _looks(search, start, number):
            contacts = find_contacts(hand, obj, back, joints, bounds)
            planes = None if resting is None else resting[rows]
            found, now = check_grasps(hand, obj, back, joints, contacts, bounds, resting=planes, index=index[rows])
            if table is None:
                table, outcome = found, now
                continue
            passed, had = now == Outcome.KEPT, outcome[rows] == Outcome.KEPT
            lower = found.metrics["unresisted_load"] < table.metrics["unresisted_load"][rows]
            better = passed & (~had | lower) | (~had & (number == 0))
            table = choose_grasps(table, found, rows[better], np.flatnonzero(better))
            outcome[rows[better]] = now[better]
    assert table is not None
    return table, outcome


def _start(search: Descent, hand: HandArrays, pose: np.ndarray, q: np.ndarray, number: int) -> Hands:
    """Hands where a try begins: the first where they are, others near by, each try in its own way."""
    base, tree = device_inverse(pose), hand.model.tree
    if number:
        rng = np.random.default_rng(number)
        base[:, :3] += (_START_SHIFT * rng.normal(size=3)).astype(np.float32)
        q = np.clip(q + _START_BEND * rng.normal(size=q.shape[1]), tree.joint_lower, tree.joint_upper)
    return Hands.put(base, q, search.device)


def _looks(search: Descent, at: Hands, number: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """T_hand_object and joints of hands along a search."""
    rounds = search.params.matching_rounds * (2 if number else 1)
    stops = [*range(_ROUNDS_PER_LOOK, rounds, _ROUNDS_PER_LOOK), rounds]
    for first, stop in zip([0, *stops[:-1]], stops, strict=True):
        if stop > first:
            search.run(at, rounds=stop, first=first, whole=rounds)
        base, q = at.arrays()
        yield device_inverse(base), q.copy()
