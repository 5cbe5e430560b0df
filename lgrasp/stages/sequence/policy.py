"""Which opposition spaces a sequence may take its next object with."""

from collections.abc import Sequence

import numpy as np

from lgrasp.grasp.sequences import SequenceTable
from lgrasp.hand.spaces import Space, available, longest
from lgrasp.seeding import stage_seed

__all__ = ["choose_spaces"]


def choose_spaces(
    table: SequenceTable, spaces: Sequence[Space], policy: str, left: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """The next step's opposition spaces.

    ``uniform`` draws one of those that are left (Alg. 1, line 3). ``lookahead`` takes all of those after which the
    objects still to come can follow; if there are none, those after which most can.

    Args:
        table: N sequences.
        left: objects still to come after this one.

    Returns:
        Row and space of each way to go on, (M,) each, rows rising; a consumed row has none.
    """
    rng = np.random.default_rng(stage_seed(seed, 0, "space", table.steps))
    drawn = rng.random(len(table))
    used = table.used
    rows, chosen = [], []
    for i in range(len(table)):
        taken = frozenset(table.space[i].tolist())
        able = available(spaces, taken, used[i])
        if policy == "lookahead" and able:
            later = [min(longest(spaces, taken | {s}, used[i] | spaces[s].joints), left) for s in able]
            able = [s for s, n in zip(able, later, strict=True) if n == max(later)]
        elif able:
            able = [able[int(drawn[i] * len(able))]]
        rows += [i] * len(able)
        chosen += able
    return np.array(rows, int), np.array(chosen, int)
