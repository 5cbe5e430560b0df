"""The bank: the state of a shard, kept so that a later run that requests more rows can continue from it, or after an
interruption any run."""

import json
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lgrasp.engine.cache import Cache, content_key
from lgrasp.engine.inputs import InputKeys
from lgrasp.engine.pipeline import Pipeline
from lgrasp.grasp.tables import GraspTable, grasp_arrays, table_of
from lgrasp.runtime.tally import covered

BANK_VERSION = 5
"""Raised whenever the arrays of an entry change meaning; the versions of the stages are in the key too."""
_NUMBERS_MEMBER = "about"  # member with the numbers
_BANKED = ("candidates", "duplicates", "counts", "seconds", "spans", "waited")  # those of a result


@dataclass
class ShardResult:
    """Rows of a shard and how they came about."""

    grasps: GraspTable
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)  # thread-seconds per stage
    spans: list[tuple[float, float]] = field(default_factory=list)  # from when to when each run took [s since 1970]
    waited: float = 0.0  # while other shards used the device [s]
    candidates: int = 0
    duplicates: int = 0
    exhausted: bool = False  # the effort bound was reached before the rows were
    resumed: int = 0  # rows that an earlier run gave, or found until it was interrupted
    tally: Counter[str] = field(default_factory=Counter)  # what the job counts among its rows

    @property
    def wall(self) -> float:
        """Placement through filter, of all runs, without waiting for shards that are made side by side [s]."""
        return max(covered(self.spans) - self.waited, 0.0)


class Account(NamedTuple):
    """A shard so far: the first ``kept`` rows are its own, later ones were found with the last and not looked at."""

    found: ShardResult
    kept: int
    interrupted: bool


@dataclass(frozen=True)
class Bank:
    """The account of one shard in the cache. With it or without, a shard has the same rows."""

    cache: Cache
    pipeline: Pipeline
    keys: InputKeys
    shard: int
    device: str

    @property
    def key(self) -> str:
        """Content key: all that decides the rows of the shard, and the kind of device, which rounds its own way."""
        return content_key(
            "bank",
            BANK_VERSION,
            pipeline=self.pipeline.describe(),
            inputs=[self.keys.hand, self.keys.object, self.keys.field],
            shard=self.shard,
            device=self.device.partition(":")[0],
        )

    def load(self, rows: int, *, whole: bool = True) -> Account | None:
        """The account (if ``whole``, of a finished shard, too), or None if a shard of ``rows`` rows cannot continue
        from any; damage is reported."""
        arrays = self.cache.load("bank", self.key)
        if arrays is None:
            return None
        try:
            about = json.loads(str(arrays.pop(_NUMBERS_MEMBER)))
            about["spans"] = [(begin, end) for begin, end in about["spans"]]
            found = ShardResult(table_of(GraspTable, arrays), **{name: about[name] for name in _BANKED})
            account = Account(found, about["kept"], about["interrupted"])
        except (KeyError, ValueError, TypeError):
            self.cache.warn(f"bank {self.cache.path('bank', self.key)} is damaged; rebuilding it")
            return None
        return account if account.kept <= rows and (whole or account.interrupted) else None

    def store(self, account: Account) -> None:
        """Keep the account, in place of an earlier one."""
        about = {"kept": account.kept, "interrupted": account.interrupted}
        about |= {name: getattr(account.found, name) for name in _BANKED}
        arrays = grasp_arrays(account.found.grasps) | {_NUMBERS_MEMBER: np.asarray(json.dumps(about))}
        self.cache.store("bank", self.key, arrays)

    def discard(self) -> None:
        """Forget the account, if there is one."""
        self.cache.discard("bank", self.key)
