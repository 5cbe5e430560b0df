"""With which opposition spaces a sequence may take its next object."""

from collections.abc import Sequence

import numpy as np

from lgrasp.grasp.sequences import SequenceTable
from lgrasp.hand.opposition.spaces import Space, available, longest
from lgrasp.seeding import stage_seed


def space_orders(table: SequenceTable, spaces: Sequence[Space], policy: str, left: int, seed: int) -> np.ndarray:
    """The next step's opposition spaces of each row, in the order in which they are tried.

    ``uniform`` draws one of those that are left (Alg. 1, line 3) and no other. ``lookahead`` takes all of those after
    which the objects still to come can follow, in a random order; if there are none, those after which most can.

    Args:
        table: N sequences.
        left: objects still to come after this one.

    Returns:
        Indices of spaces, (N, S), -1 from where there is no other on; a consumed row has none.
    """
    rng = np.random.default_rng(stage_seed(seed, 0, "space", table.steps))
    drawn = rng.random((len(table), len(spaces)))
    used = table.used
    order = np.full((len(table), len(spaces)), -1)
    able_of: dict[tuple[tuple[int, ...], bytes], list[int]] = {}
    for i in range(len(table)):
        taken = tuple(sorted(table.space[i].tolist()))
        state = taken, used[i].tobytes()
        if state not in able_of:
            able_of[state] = _able(spaces, taken, used[i], policy, left)
        able = sorted(able_of[state], key=lambda s, i=i: drawn[i, s])
        able = able if policy == "lookahead" else able[:1]
        order[i, : len(able)] = able
    return order


def _able(spaces: Sequence[Space], taken: tuple[int, ...], used: np.ndarray, policy: str, left: int) -> list[int]:
    """Spaces that a sequence may continue with."""
    able = available(spaces, taken, used)
    if policy == "uniform" or not able:
        return able
    later = [min(longest(spaces, (*taken, s), used | spaces[s].joints), left) for s in able]
    return [s for s, n in zip(able, later, strict=True) if n == max(later)]
