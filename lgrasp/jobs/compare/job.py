"""Hands compared on objects: a shard of each hand with each object, their numbers, and a page."""

from dataclasses import asdict
from typing import Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from lgrasp.engine.cache import content_key
from lgrasp.engine.events import JobOutcome, Made, Part, PartProgress
from lgrasp.engine.folder import shard_path
from lgrasp.engine.inputs import Loader
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.run import Job
from lgrasp.hand.workspace import WORKSPACE_VERSION, Workspace, measure_workspace
from lgrasp.hold.params import HoldTest
from lgrasp.jobs.compare.cell import make_cell
from lgrasp.jobs.compare.hands import ComparedHand, compared_hands
from lgrasp.jobs.compare.measure import measure_cell, measure_hand
from lgrasp.jobs.compare.page import write_page
from lgrasp.jobs.config import pair_requests
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.requests.compare import CompareRequest
from lgrasp.object.find import all_objects

PAGE = "compare.html"
"""File of the page, in the folder of the job."""


class CompareJob(CompareRequest, Job):
    """A part is the shard of one hand with one object: its grasps, the metrics of the hold test, and verdicts."""

    command: ClassVar[str] = "hands compare"
    part: ClassVar[str] = "hand with object"
    one_key: ClassVar[bool] = False
    differs: ClassVar[str] = "other hand, object, pipeline, rows or protocol"

    _hands: list[ComparedHand] | None = PrivateAttr(None)
    _pairs: list[tuple[ComparedHand, GenerateJob]] | None = PrivateAttr(None)

    @property
    def compared(self) -> list[ComparedHand]:
        """The hands, each followed by its variants."""
        if self._hands is None:
            self._hands = compared_hands(self.hands, self.variations(), self.cache)
        return self._hands

    @property
    def pairs(self) -> list[tuple[ComparedHand, GenerateJob]]:
        """Each hand with each object, as the job that makes its grasps."""
        if self._pairs is None:
            pipeline, objects = load_pipeline(self.pipeline).with_seed(self.seed).impatient(), all_objects(self.objects)
            how = {"rows": self.rows, "shard_rows": self.rows, "device": self.device, "workers": self.workers}
            sources = [hand.source for hand in self.compared]
            jobs = [r.job(self.cache) for r in pair_requests(sources, objects, pipeline, self.out, **how)]
            self._pairs = [(self.compared[k // len(objects)], job) for k, job in enumerate(jobs)]
        return self._pairs

    def key(self) -> str:
        return content_key("compare", 1, parts=[self.part_key(part) for part in self.parts()])

    def part_key(self, part: Part) -> str:
        job = self.pairs[part.number][1]
        return content_key(
            "compared", 1, grasps=job.key(), rows=self.rows, hold=HoldTest().model_dump(mode="json"), by=self.simulate
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
            :class:`~lgrasp.hand.workspace.Workspace`), ``objects`` (numbers by object, see
            :func:`~lgrasp.jobs.compare.measure.measure_cell`) and ``all``; ``missing`` parts; ``page``.
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
                    "objects": objects,
                    "all": measure_hand(objects, files[hand.name]),
                }
            )
        told = {"hands": hands, "missing": missing, "asked_rows": self.rows, "page": None}
        data = told | {"pipeline": self.pairs[0][1].pipeline.name, "simulate": self.simulate}
        if hands:
            data["page"] = str(self.out / PAGE)
            write_page(data | {"device": outcome.device.name}, files, self.out / PAGE)
        return data

    def _workspace(self, job: GenerateJob) -> Workspace:
        key = content_key("workspace", WORKSPACE_VERSION, hand=job.keys.hand)

        def make() -> dict[str, np.ndarray]:
            model = Loader(self.cache, self.device_used.alias).hand(job.keys.source, job.keys.hand)
            return {name: np.asarray(value) for name, value in asdict(measure_workspace(model)).items()}

        found, _ = self.cache.get("workspace", key, make)
        return Workspace(**{name: float(value) for name, value in found.items()})
