"""The main job: hand + object -> grasp shards in a folder."""

from collections import Counter
from concurrent.futures import BrokenExecutor
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import PrivateAttr, model_validator

from lgrasp.dataset.info import last_survivors, survivors
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.bank import Bank
from lgrasp.engine.events import Events, JobOutcome, Made, Part, PartProgress
from lgrasp.engine.folder import Found
from lgrasp.engine.graphs import GraphCache
from lgrasp.engine.inputs import InputKeys, Inputs, input_keys, load_inputs, run_key
from lgrasp.engine.shard import Execution, gave_up, make_shard
from lgrasp.errors import ConfigError, LgraspError, StarvedError
from lgrasp.geometry.mesh_files import mesh_bytes, mesh_digest
from lgrasp.grasp.records import ObjectRecord
from lgrasp.grasp.rows import grasp_rows
from lgrasp.grasp.tables import take_grasps
from lgrasp.hand.model import HandModel
from lgrasp.jobs.bottleneck import starving_stage
from lgrasp.jobs.hands import FEWEST_CONTACTS, for_hand, hand_source, own_policy
from lgrasp.jobs.records import object_record
from lgrasp.jobs.requests.search import GenerateRequest
from lgrasp.jobs.row_counts import count_made, count_written
from lgrasp.jobs.search import SearchJob
from lgrasp.policy.names import SHIPPED
from lgrasp.runtime.cores import cores
from lgrasp.runtime.processes import ProcessPool, none_killed
from lgrasp.words import plural

_SHARDS_ON_GPU = 4  # at once
_MOST_WRITERS = 8
_LOOSE_LOAD = 0.25
"""Bound of the unresisted load that hands of few fingers meet."""


class GenerateJob(GenerateRequest, SearchJob):
    """Grasps of one object by one hand."""

    command: ClassVar[str] = "generate"

    _graphs: GraphCache | None = PrivateAttr(None)
    _rate: float = PrivateAttr(1.0)
    _tried: Counter[str] = PrivateAttr(default_factory=Counter)
    _writers: ProcessPool | None = PrivateAttr(None)

    @model_validator(mode="after")
    def _for_hand(self) -> Self:
        self.pipeline = for_hand(self.pipeline, self.hand)
        return self

    @property
    def object_name(self) -> str:
        assert self.keys.mesh is not None
        return self.keys.mesh.stem

    @property
    def object_hashes(self) -> set[str]:
        assert self.keys.mesh is not None
        return {mesh_digest(mesh_bytes(self.keys.mesh))}

    @property
    def protocol(self) -> str | None:
        return self.pipeline.params("simulate").protocol if "simulate" in self.pipeline.order else None

    @cached_property
    def keys(self) -> InputKeys:
        """Content keys of hand, object and field."""
        source, pipeline = hand_source(self.hand), self.pipeline
        return input_keys(source, self.object, self.scale, pipeline.object, pipeline.field, pipeline.hand)

    @property
    def measured_rate(self) -> float:
        """Rows per candidate of the shards made; ``rate`` if none was."""
        return self._rate if self._inputs else self.rate

    def own_config(self) -> dict[str, Any]:
        own = {"object": self.object, "scale": self.scale}
        return own | ({"negatives": self.negatives} if self.negatives else {})

    def key(self) -> str:
        described = self.pipeline.describe() | ({"negatives": self.negatives} if self.negatives else {})
        return run_key(described, self.keys, self.shard_rows)

    def gave_up(self, rows: int, found: Found) -> bool:
        return gave_up(self.pipeline, rows, found.rows, found.tried)

    def begin(self) -> None:
        if self.writers() > 1:
            try:
                self._start_writers()
            except BrokenExecutor:  # those of the job before, of which one was killed since
                self.cache.kept.forget("writers")
                self._start_writers()

    def _start_writers(self) -> None:
        self._writers = self.cache.kept.get("writers", self.writers(), partial(ProcessPool, self.writers()))
        self._writers.start(write_shard.__module__)

    def load_inputs(self, events: Events) -> Inputs:
        pipeline, device, self._rate = self.pipeline, self.device_used, self.rate
        self._graphs = GraphCache(pipeline) if self.replays else None
        what = self.keys, self.scale, pipeline.object, pipeline.field, device, events.loading
        return load_inputs(self.cache, *what, table=pipeline.on_table, steer=pipeline.steer)

    def records(self, inputs: Inputs) -> tuple[HandModel, list[ObjectRecord]]:
        return inputs.hand.model, [
            object_record(inputs.object.model, tables=inputs.object.planes, steered=inputs.object.steered)
        ]

    @property
    def replays(self) -> bool:
        """Whether batches are replayed: by one worker on a GPU."""
        return self.device_used.is_cuda and self.threads() == 1

    def at_once(self) -> int:
        # on the host a GPU's shard is finished while the next are searched
        alone = self.negatives or self.protocol or self.pipeline.params("search").passes > 1
        return 1 if alone or not self.replays else _SHARDS_ON_GPU

    def writers(self) -> int:
        # one thread writes a tenth of what a GPU finds
        return min(_MOST_WRITERS, cores(), self.known_parts) if self.at_once() > 1 else 1

    def write(self, part: Part, contents: Any) -> None:
        if self._writers is None:
            super().write(part, contents)
            return
        with none_killed(f"writes {part.file}"):
            try:
                self._writers.submit(write_shard, part.file, contents).result()
            except BrokenExecutor:
                self.cache.kept.forget("writers")
                self.clean([part])
                raise

    def close(self) -> None:
        self._writers = None
        if not self.cache.more_jobs:
            self.cache.kept.forget("writers")

    def make(self, part: Part, progress: PartProgress) -> Made:
        result = make_shard(
            self.pipeline,
            self.inputs,
            part.number,
            part.rows,
            Execution(self.threads(), self.batch, self._rate, self._graphs),
            bank_cache=self.cache,
            banked=part.rows < self.shard_rows or part.number in self._growing,
            resume=part.number in self._growing,
            progress=lambda rows, result: progress(rows, kept=result.resumed),
        )
        self._tried.update(candidates=result.candidates, rows=last_survivors(result.counts))
        self._rate = max(self._tried["rows"] / self._tried["candidates"], 1e-3)
        # poses and contacts go from the internal to the user's frame of the object
        tree, center = self.inputs.hand.model.tree, self.inputs.object.model.center
        grasps, told = result.grasps, {"candidates": result.candidates}
        if self.negatives and len(grasps):
            from lgrasp.jobs.negatives import with_negatives

            grasps = with_negatives(grasps, self.pipeline, self.inputs, part.number, self.negatives)
            told["negatives"] = len(grasps) - len(result.grasps)
        rows = grasp_rows(grasps, tree, center, shard=part.number, protocol=self.protocol_text())
        contents = self.shard(part, result, rows, told)
        result.tally = count_made(rows, contents.header.config, self._moving)
        # a copy: memory must not grow with the shards
        forgotten = replace(result, grasps=take_grasps(result.grasps, np.zeros(0, int)))
        return Made(len(result.grasps), contents, forgotten, result.resumed)

    @property
    def _moving(self) -> np.ndarray:
        """Which links of the hand are moved by a finger, (L,)."""
        tree = self.inputs.hand.model.tree
        return tree.body_group[tree.link_body] >= 0

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        """The results in numbers; rates are those of the shards that this call made.

        Returns:
            ``grasps``, ``strict`` (those within the strict bounds) and ``profile`` (by which all are valid, and the
            bounds that are looser than it);
            ``grasps_per_s``, ``strict_valid_per_s``, ``published_count_per_s`` (over the wall time of placement through
            filter), ``seconds`` (thread-seconds per stage; ``wall`` of placement through filter; hand, object, field),
            ``survivors`` and ``counts`` per stage, ``near_duplicates`` (across shards), ``distinct_poses``,
            ``force_closure`` (share), ``negatives`` if they were, and of objects on a table
            ``resting``: ``probability`` and ``rows`` of each resting pose.
        """
        inputs = self.inputs
        made = sum((result.tally for result in outcome.results), Counter())
        written = set(outcome.written)
        present, counted, near = count_written(outcome.paths, written, self._moving, inputs.device.alias)
        sums = self.sums(outcome, self.pipeline.order)
        if not outcome.results:
            sums["counts"] |= counted
        wall, both = sums["seconds"]["wall"], made + present
        if (asked := inputs.steer.poses) is not None:  # the same in every shard
            both["distinct_poses"] = min(both["distinct_poses"], len(asked))
        rates = {"grasps": "rows", "strict_valid": "strict", "published_count": "published_count"}
        counts = ("strict", "distinct_poses", "published_count")
        planes = inputs.object.planes
        resting = (
            [{"probability": float(p), "rows": both[f"pose {k}"]} for k, p in enumerate(planes[:, 4])]
            if planes is not None and not self.pipeline.steer.above
            else []
        )
        return {
            "grasps": outcome.rows,
            **{name: both[name] for name in counts},
            **({"negatives": both["negatives"]} if self.negatives else {}),
            "force_closure": both["closed"] / both["rows"] if both["rows"] else None,
            "near_duplicates": near,
            "profile": self.pipeline.bounds.told,
            **{f"{name}_per_s": made[of] / wall if wall else 0.0 for name, of in rates.items()},
            "survivors": survivors(sums["counts"]),
            "object": inputs.object.model.name,
            **({"resting": resting} if resting else {}),
            **sums,
        }

    def kept_of(self, part: Part) -> int:
        bank = Bank(self.cache, self.pipeline, self.keys, part.number, self.device_used.alias)
        account = bank.load(part.rows, whole=False)
        return account.kept if account else 0

    def shortfall(self, outcome: JobOutcome) -> LgraspError | None:
        if not outcome.starved:
            return None
        counts = self.report(outcome)["counts"]
        if self.pipeline.steer.asks and not counts["place"].get("kept", 1):
            asked = self.inputs.steer.poses
            poses = (
                f"{counts['place']['tried']:,} poses" if asked is None else f"{plural(len(asked), 'pose')} of the file"
            )
            return ConfigError(
                f"steer leaves nothing: at none of {poses} could hand '{self.keys.source.name}' hold {self.object_name}"
            )
        few = f"{outcome.rows:,} of {self.rows:,} grasps found"
        if (passed := last_survivors(counts)) > 2 * outcome.rows > 0:
            return StarvedError(
                f"{few}; of {passed:,} that passed, the others are near-duplicates of these: hand "
                f"'{self.keys.source.name}' has few more for {self.object_name} with pipeline {self.pipeline.name}"
            )
        stage, words = starving_stage(counts)
        if stage in ("close", "search") and self.pipeline.bounds.min_contacts > FEWEST_CONTACTS:
            words += "; grasps of fewer contacts: --pipeline robust"
        elif stage in ("search", "hold") and self.pipeline.bounds.max_unresisted_load < _LOOSE_LOAD:
            words += f"; grasps that resist less: --set bounds.max_unresisted_load={_LOOSE_LOAD}, or --pipeline swift"
        untried = self.pipeline.params("place").policy is None and own_policy(self.pipeline, self.keys.source)
        if stage in ("search", "hold") and untried:
            words += f"; likelier poses: --set place.policy={SHIPPED}"
        if asked := self.pipeline.steer.model_dump(exclude_defaults=True):
            words += f"; what is asked ({', '.join(f'steer.{name}' for name in asked)}) may leave few grasps or none"
        return StarvedError(f"{few}; stage {stage} is the bottleneck: {words}")
