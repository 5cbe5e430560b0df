"""Hands moved until they pass the checks: a local search, evaluated on its way, restarted nearby if it fails."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from lgrasp.geometry.poses import device_inverse
from lgrasp.grasp.outcomes import Outcome
from lgrasp.grasp.tables import GraspTable, choose_grasps, join_rows
from lgrasp.hand.arrays import HandArrays
from lgrasp.refine.descent import Descent
from lgrasp.refine.hands import Hands
from lgrasp.runtime.cores import cores

_ROUNDS_PER_LOOK = 4  # matching rounds between two looks
_START_SHIFT, _START_BEND = 0.003, 0.03  # spread of further starts [m], [rad or m]
_CPU_ROWS = 32  # of one thread

Check = Callable[..., tuple[GraspTable, np.ndarray]]


def improve(
    search: Descent,
    hand: HandArrays,
    check: Check,
    pose: np.ndarray,
    q: np.ndarray,
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
        check: what the checks find of postures, as :func:`~lgrasp.grasp.find_contacts.check_found` does.
        pose: T_hand_object of the object's internal frame, x y z [m] qx qy qz qw, (n, 7).
        q: joint positions within their limits [rad or m], (n, K).
        tries: most searches of each hand, (n,).
        resting: as of :func:`~lgrasp.grasp.check.check_grasps`.
        index: candidate of each row.

    Returns:
        Rows in the order given, and their outcomes (:class:`~lgrasp.grasp.outcomes.Outcome`), (n,).
    """

    def improved(own: np.ndarray) -> tuple[GraspTable, np.ndarray]:
        """The same of some of them, by index."""
        table, outcome = None, np.full(len(own), Outcome.CONTACT)
        for number in range(int(tries[own].max(initial=1))):
            rows = np.flatnonzero((outcome != Outcome.KEPT) & (tries[own] > number)) if number else np.arange(len(own))
            at = own[rows]
            if not len(rows):
                break
            planes = None if resting is None else resting[at]
            for back, joints in _looks(search, _start(search, hand, pose[at], q[at], number), number):
                found, now = check(back, joints, resting=planes, index=index[at])
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

    size = _CPU_ROWS if search.device == "cpu" else max(len(q), 1)
    parts = np.split(np.arange(len(q)), range(size, len(q), size))
    if len(parts) == 1:
        return improved(parts[0])
    with ThreadPoolExecutor(cores()) as pool:
        tables, outcomes = zip(*pool.map(improved, parts), strict=True)
    return join_rows(list(tables)), np.concatenate(outcomes)


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
