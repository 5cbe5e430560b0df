"""The candidate bank: contacts of a batch of poses, kept on disk so that later runs need not make them again."""

import json
from dataclasses import dataclass

import numpy as np

from lgrasp.engine.cache import Cache, content_key
from lgrasp.engine.inputs import InputKeys
from lgrasp.engine.pipeline import Pipeline
from lgrasp.grasp.tables import CandidateTable, candidate_arrays, candidate_table

BANK_CANDIDATES = 1024
"""Candidates of one bank entry; the batch size of a run that keeps banks."""
BANK_VERSION = 2
"""Raised whenever the arrays of an entry change meaning; the versions of the stages are in the key too."""


@dataclass(frozen=True)
class Bank:
    """Bank entries of one shard's stream."""

    cache: Cache
    pipeline: Pipeline
    keys: InputKeys
    shard: int
    device: str

    def key(self, first: int, count: int) -> str:
        """Content key of the candidates ``first .. first + count - 1``: the stages before search and their inputs."""
        described = self.pipeline.describe()["stages"][: self.pipeline.order.index("search")]
        return content_key(
            "bank",
            BANK_VERSION,
            stages=described,
            seed=self.pipeline.seed,
            inputs=[self.keys.hand, self.keys.object, self.keys.field],
            shard=self.shard,
            candidates=[first, count],
        )

    def has(self, first: int, count: int) -> bool:
        return self.cache.has("bank", self.key(first, count))

    def load(self, first: int, count: int) -> tuple[CandidateTable, dict[str, dict[str, int]]] | None:
        """The banked candidates on the device and the survivors per stage when they were made, or None."""
        arrays = self.cache.load("bank", self.key(first, count))
        if arrays is None:
            return None
        try:
            return candidate_table(arrays, self.device), json.loads(str(arrays["counts"]))
        except (KeyError, ValueError, RuntimeError):
            self.cache.warn(f"bank {self.cache.path('bank', self.key(first, count))} is damaged; it is made anew")
            return None

    def store(self, first: int, count: int, table: CandidateTable, counts: dict[str, dict[str, int]]) -> None:
        arrays = candidate_arrays(table) | {"counts": np.asarray(json.dumps(counts))}
        self.cache.store("bank", self.key(first, count), arrays)
