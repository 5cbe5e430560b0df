"""Hands compared on objects: a shard of each hand with each object, their numbers, and a page."""

from collections.abc import Collection, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from lgrasp.choices import ProtocolName
from lgrasp.dataset.reader import count_rows, read_shard
from lgrasp.engine.cache import Cache, content_key
from lgrasp.engine.events import CancelledError, Events, JobOutcome, Made, Part, PartProgress
from lgrasp.engine.folder import shard_path
from lgrasp.engine.inputs import Loader
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.run import Job, run
from lgrasp.errors import HandError, LgraspError, StarvedError
from lgrasp.files import temporary_folder
from lgrasp.grasp.records import Shard
from lgrasp.grasp.schema import MADE_FROM
from lgrasp.hand.digest import hand_digest
from lgrasp.hand.drafting.vary import write_variant
from lgrasp.hand.names import all_hands
from lgrasp.hand.spec import load_spec
from lgrasp.hand.workspace import WORKSPACE_VERSION, Workspace, measure_workspace
from lgrasp.hold.params import HoldTest
from lgrasp.jobs.compare.measure import measure_cell, measure_hand
from lgrasp.jobs.compare.page import WITHOUT_ROWS, write_page
from lgrasp.jobs.config import pair_requests
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.hands import hand_source, hand_types
from lgrasp.jobs.metrics import HOLD, MetricsJob
from lgrasp.jobs.requests.compare import CompareRequest, Variation, parse_variations
from lgrasp.jobs.simulate import SimulateJob
from lgrasp.object.find import all_objects
from lgrasp.simulate.protocol import find_protocol

_VERSION = 1  # of variants
_TEST = HoldTest(draws=0)  # the trial with the numbers of fc is compared


class ComparedHand(NamedTuple):
    """A hand of a comparison."""

    name: str
    source: str
    """As jobs take it: a name or a path."""
    of: str
    """Name of the hand that it is, or is a variant of."""
    variation: Variation | None


def _varied(name: str, variation: Variation, cache: Cache) -> ComparedHand:
    source = hand_source(name)
    content = hand_digest(source.urdf, source.spec)
    rules = source.spec.model_dump(mode="json") | {"roles": source.spec.roles}  # digests of hands leave some out
    key = content_key("variant", _VERSION, content=content, rules=rules, variation=list(variation))
    label = f"{source.name}-{variation.label}"
    folder = cache.root / "variants" / key[:32] / label
    try:
        load_spec(folder / "hand.yaml")
    except HandError:  # not written yet, or unreadable
        write_variant(source, variation.kind, variation.factor, label, folder)
    return ComparedHand(label, str(folder), source.name, variation)


PAGE = "compare.html"
"""File of the page, in the folder of the job."""


class CompareJob(CompareRequest, Job):
    """A part is the shard of one hand with one object: its grasps, the metrics of the hold test, and verdicts."""

    command: ClassVar[str] = "hands compare"
    part: ClassVar[str] = "hand with object"
    one_key: ClassVar[bool] = False
    differs: ClassVar[str] = "other hand, object, pipeline, rows or protocol"

    @cached_property
    def compared(self) -> list[ComparedHand]:
        """The hands, each followed by its variants, which are written into the cache where they are missing.

        Raises:
            HandError: there is no such hand, or it cannot be varied so.
        """
        found = []
        for name in all_hands(self.hands):
            own = hand_source(name).name
            found.append(ComparedHand(own, name, own, None))
            found += [_varied(name, variation, self.cache) for variation in parse_variations(self.vary)]
        return found

    @cached_property
    def pairs(self) -> list[tuple[ComparedHand, GenerateJob]]:
        """Each hand with each object, as the job that makes its grasps."""
        pipeline, objects = load_pipeline(self.pipeline).with_seed(self.seed).impatient(), all_objects(self.objects)
        how: dict[str, Any] = {"rows": self.rows, "shard_rows": self.rows}
        how |= {"device": self.device, "workers": self.workers}
        requests = pair_requests([hand.source for hand in self.compared], objects, pipeline, self.out, **how)
        return [(self.compared[k // len(objects)], r.job(self.cache)) for k, r in enumerate(requests)]

    def key(self) -> str:
        return content_key("compare", 1, parts=[self.part_key(part) for part in self.parts()])

    def part_key(self, part: Part) -> str:
        job = self.pairs[part.number][1]
        return content_key(
            "compared", 1, grasps=job.key(), rows=self.rows, hold=_TEST.model_dump(mode="json"), by=self.simulate
        )

    def parts(self) -> list[Part]:
        files = [shard_path(job.out, hand.name, job.object_name, 0) for hand, job in self.pairs]
        return [Part(number, file, self.rows, index=0) for number, file in enumerate(files)]

    def about(self) -> dict[str, Any]:
        objects = dict.fromkeys(job.object_name for _, job in self.pairs)
        pipeline = self.pairs[0][1].pipeline
        hands = ", ".join(hand.name for hand in self.compared)
        return {"hand": hands, "objects": list(objects), "pipeline": pipeline.name, "seed": pipeline.seed}

    def make(self, part: Part, progress: PartProgress) -> Made:
        shard = make_cell(self.pairs[part.number][1], self.simulate, self.part_key(part), progress)
        return Made(len(shard.grasps), shard)

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        """Numbers of what is on disk, those of other tasks of an array included; they are written as a page as well.

        Returns:
            ``hands``: of each ``hand``, ``of`` (the hand that it is a variant of), ``variation``, ``workspace`` (see
            :class:`~lgrasp.hand.workspace.Workspace`), ``grasp_types`` that it makes, each with others that ask for
            the same contacts, ``objects`` (numbers by object, see
            :func:`~lgrasp.jobs.compare.measure.measure_cell`) and ``all``; ``missing`` parts; ``short``: ``hand``,
            ``object`` and ``rows`` where these are fewer than asked; ``page``.
        """
        hands, files, missing = [], {}, 0
        parts = self.parts()
        for hand in self.compared:
            own = [(part, job) for part, (other, job) in zip(parts, self.pairs, strict=True) if other is hand]
            there = [(part.file, job) for part, job in own if part.file.is_file()]
            missing += len(own) - len(there)
            if not there:
                continue
            files[hand.name] = [file for file, _ in there]
            objects = {job.object_name: measure_cell(file, self.simulate) for file, job in there}
            hands.append(
                {
                    "hand": hand.name,
                    "of": hand.of,
                    "variation": hand.variation and hand.variation.label,
                    "workspace": asdict(self._workspace(there[0][1])),
                    "grasp_types": hand_types(there[0][1].keys.source),
                    "objects": objects,
                    "all": measure_hand(objects, files[hand.name]),
                }
            )
        told = {"hands": hands, "missing": missing, "asked_rows": self.rows, "page": None}
        told["short"] = self._short([path for paths in files.values() for path in paths])
        data = told | {"pipeline": self.pairs[0][1].pipeline.name, "simulate": self.simulate}
        if hands:
            data["page"] = str(self.out / PAGE)
            write_page(data | {"device": outcome.device.name}, files, self.out / PAGE)
        return data

    def shortfall(self, outcome: JobOutcome) -> LgraspError | None:
        short = self._short(outcome.paths)
        pairs = ", ".join(f"{s['hand']} with {s['object']} {s['rows']:,}" for s in short)
        return StarvedError(f"fewer than {self.rows:,} grasps: {pairs}; {WITHOUT_ROWS}") if short else None

    def _short(self, files: Collection[Path]) -> list[dict[str, Any]]:
        """``hand``, ``object`` and ``rows`` of those files that have fewer than asked."""
        return [
            {"hand": hand.name, "object": job.object_name, "rows": rows}
            for part, (hand, job) in zip(self.parts(), self.pairs, strict=True)
            if part.file in files and (rows := count_rows(part.file)) < self.rows
        ]

    def _workspace(self, job: GenerateJob) -> Workspace:
        key = content_key("workspace", WORKSPACE_VERSION, hand=job.keys.hand)

        def make() -> dict[str, np.ndarray]:
            model = Loader(self.cache).hand(job.keys.source, job.keys.hand)
            return {name: np.asarray(value) for name, value in asdict(measure_workspace(model)).items()}

        found, _ = self.cache.get("workspace", key, make)
        return Workspace(**{name: float(value) for name, value in found.items()})


def make_cell(job: GenerateJob, protocol: ProtocolName | None, key: str, progress: PartProgress) -> Shard:
    """The grasps of a job with the metrics of the hold test, and with the verdicts of a protocol.

    Args:
        job: its folder is not used.
        key: content key that the shard is marked with.

    Raises:
        CancelledError: the job is to stop.
        LgraspError: see the jobs.
    """
    how: dict[str, Any] = {"device": job.device, "workers": job.workers, "cache": job.cache}
    told = _Told(progress)
    with temporary_folder() as folder:
        _run(job.changed(out=folder / "grasps"), told)
        told.what = "hold test"
        draws = (f"hold.draws={_TEST.draws}",)
        tried = MetricsJob(shards=(folder / "grasps",), out=folder / "tried", add=(HOLD,), settings=draws, **how)
        (path,) = _run(tried, told)
        if protocol is not None:
            told.what, how["device"] = protocol, "cpu"
            simulated = SimulateJob(shards=(path,), protocol=find_protocol(protocol), out=folder / "simulated", **how)
            (path,) = _run(simulated, told)
        shard = read_shard(path)
    return replace(shard, statistics={**shard.statistics, MADE_FROM: key})


def _run(job: Job, events: Events) -> Sequence[Path]:
    outcome = run(job, events)
    if outcome.cancelled:
        raise CancelledError
    return outcome.paths


class _Told(Events):
    """What the part of a comparison tells of the jobs that it runs."""

    def __init__(self, progress: PartProgress) -> None:
        self._progress, self._kept = progress, 0
        self.what = ""
        """Is being done with the rows; none: they are being made."""

    def said(self, words: str) -> None:
        self._progress.events.said(words)

    def advanced(self, part: Part, done: int, note: str = "", ahead: float = 0.0, kept: int = 0) -> None:
        # the last row is told when the part is on disk: until then it may be stopped
        last = self._progress.part.rows - 1
        if not self.what:
            self._kept = min(kept, last)
        self._progress(last if self.what else min(done, last), self.what, kept=self._kept)

    def cancelled(self) -> bool:
        return self._progress.events.cancelled()
