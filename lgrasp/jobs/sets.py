"""Object sets and their orders, drawn from a pool with a seed, for a config of sequences."""

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from pydantic import Field

from lgrasp.choices import Method, Policy, ProtocolName
from lgrasp.config import Params
from lgrasp.errors import ConfigError
from lgrasp.notices import notice
from lgrasp.seeding import stage_seed


class SequenceSets(Params):
    """How sequences are drawn from the objects of a config."""

    RENAMED: ClassVar[dict[str, str]] = {"physics": "simulate"}

    sets: int = Field(600, ge=1, description="Different sets of objects.")
    length: int = Field(4, ge=2, le=16, description="Objects in a set.")
    permutations: int = Field(4, ge=1, description="Different orders of each set.")
    scale: str = Field(
        "0.06:0.10", coerce_numbers_to_str=True, description="Factor to metres, or range of the longest side [m]."
    )
    method: Method | None = Field(None, description="Replaces that of stage sequence.")
    policy: Policy | None = Field(None, description="Replaces that of stage sequence.")
    simulate: ProtocolName | None = Field(None, description="Protocol that rows must pass to be continued.")


def object_sequences(pool: Sequence[str], sets: SequenceSets, seed: int) -> list[tuple[str, ...]]:
    """Sequences of objects: ``permutations`` orders of each of ``sets`` different sets.

    Args:
        pool: objects to draw from, in any order; of two of one name the first counts.

    Raises:
        ConfigError: there are not so many sets or orders.
    """
    named: dict[str, str] = {}
    for mesh in pool:
        named.setdefault(Path(mesh).stem, mesh)
    if len(named) < len(set(pool)):
        twice = sorted({Path(mesh).stem for mesh in pool if named[Path(mesh).stem] != mesh})
        notice(f"{', '.join(twice)}: several objects of one name, of which the first is in sets")
    pool = [named[name] for name in sorted(named)]
    most, orders = math.comb(len(pool), sets.length), math.factorial(sets.length)
    if sets.sets > most:
        raise ConfigError(f"{sets.sets} sets of {sets.length} objects are requested; {len(pool)} objects make {most}")
    if sets.permutations > orders:
        raise ConfigError(f"{sets.permutations} orders are requested; {sets.length} objects have {orders}")
    import numpy as np  # slow to load, and needed by few configs

    rng = np.random.default_rng(stage_seed(seed, 0, "sets"))
    chosen: dict[tuple[int, ...], None] = {}
    if most <= 4 * sets.sets:
        every = list(itertools.combinations(range(len(pool)), sets.length))
        chosen = {every[i]: None for i in rng.permutation(most)[: sets.sets]}
    while len(chosen) < sets.sets:
        chosen[tuple(sorted(rng.choice(len(pool), sets.length, replace=False).tolist()))] = None
    out = []
    for members in chosen:
        drawn: dict[tuple[int, ...], None] = {}
        while len(drawn) < sets.permutations:
            drawn[tuple(rng.permutation(members).tolist())] = None
        out += [tuple(pool[i] for i in order) for order in drawn]
    return out
