"""The bank: the state of a shard, kept so that a later run that requests more rows can continue from it, or after an
interruption any run."""

import json
from dataclasses import dataclass

import numpy as np

from lgrasp.engine.cache import Cache, content_key
from lgrasp.engine.inputs import InputKeys
from lgrasp.engine.pipeline import Pipeline
from lgrasp.grasp.tables import GraspTable, grasp_arrays, table_of

BANK_VERSION = 5
"""Raised whenever the arrays of an entry change meaning; the versions of the stages are in the key too."""
_NUMBERS_MEMBER = "about"  # member with the numbers


@dataclass(frozen=True)
class Account:
    """A shard so far: the first ``kept`` rows are its own, later ones were found with the last and not looked at."""

    grasps: GraspTable
    kept: int
    candidates: int  # tried: the next batch begins there
    duplicates: int
    counts: dict[str, dict[str, int]]
    seconds: dict[str, float]  # thread-seconds per stage
    spans: list[tuple[float, float]]  # from when to when each run took [s since 1970]
    waited: float = 0.0  # while other shards used the device [s]
    interrupted: bool = False


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
        """The account, or None if a shard of ``rows`` rows cannot continue from any; damage is reported.

        Args:
            whole: one of a finished shard, too.
        """
        arrays = self.cache.load("bank", self.key)
        if arrays is None:
            return None
        try:
            about = json.loads(str(arrays.pop(_NUMBERS_MEMBER)))
            about["spans"] = [(begin, end) for begin, end in about["spans"]]
            account = Account(table_of(GraspTable, arrays), **about)
        except (KeyError, ValueError, TypeError):
            self.cache.warn(f"bank {self.cache.path('bank', self.key)} is damaged; rebuilding it")
            return None
        return account if account.kept <= rows and (whole or account.interrupted) else None

    def store(self, account: Account) -> None:
        """Keep the account, in place of an earlier one."""
        about = {name: value for name, value in vars(account).items() if name != "grasps"}
        self.cache.store(
            "bank", self.key, grasp_arrays(account.grasps) | {_NUMBERS_MEMBER: np.asarray(json.dumps(about))}
        )

    def discard(self) -> None:
        """Forget the account, if there is one."""
        self.cache.discard("bank", self.key)
