"""Searches joints of an arm for the rows of shards and adds them to the shards, or to copies."""

import json
import time
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from lgrasp.dataset.reader import ShardReader
from lgrasp.engine.events import Events, JobOutcome, Made, Part, PartProgress
from lgrasp.errors import ShardError
from lgrasp.geometry.poses import pose_matrix
from lgrasp.grasp.records import HandRecord
from lgrasp.jobs.records import cutter
from lgrasp.jobs.requests.shards import ReachRequest
from lgrasp.jobs.verdicts import VerdictJob
from lgrasp.reach.arm import Arm, read_arm
from lgrasp.reach.targets import CODES, hand_targets, placed_objects
from lgrasp.runtime.cores import threads

if TYPE_CHECKING:
    from lgrasp.reach.self_collision import ArmSolids


class ReachJob(ReachRequest, VerdictJob):
    """Adds joints of an arm to shards, in place or to copies."""

    command: ClassVar[str] = "reach"
    version: ClassVar[int] = 3
    kernels: ClassVar[tuple[str, ...]] = ("lgrasp.hand.pairs",)

    _solids: dict[str, "ArmSolids"] = PrivateAttr(default_factory=dict)  # by hand

    @cached_property
    def described(self) -> Arm:
        """The arm of the URDF.

        Raises:
            HandError: it cannot be used.
        """
        return read_arm(self.arm, self.tip, pose_matrix(self.mount.pose))

    @property
    def verdict(self) -> tuple[str, str]:
        return "reach", "reach_ok"

    def settings(self) -> dict[str, Any]:
        arm = self.described
        where = {name: getattr(self, name).model_dump(mode="json") for name in ("mount", "at")}
        told = {"arm": arm.urdf.name, "arm_sha256": arm.sha256, "tip": arm.tip, "version": self.version}
        return told | where | {"tries": self.tries}

    def parts(self) -> list[Part]:
        self.settings()  # an arm that cannot be used is told before shards are read
        return super().parts()

    def check_source(self, reader: ShardReader) -> None:
        if reader.columns["object_index"][0][1] != 1:
            raise ShardError(f"{reader.path}: rows of several objects cannot be placed; one object a row is accepted")

    def load(self, events: Events, missing: bool) -> None:
        if missing:
            import lgrasp.reach.search  # noqa: F401  now, before the clock starts

            if note := self.described.note:
                self.cache.warn(note)

    def make(self, part: Part, progress: PartProgress) -> Made:
        from lgrasp.reach.search import ArmSearch

        assert part.source is not None
        with ShardReader(part.source) as reader:
            rows, objects, hand, key = reader.rows(), reader.objects(), reader.hand(), self.key_of(reader)
        begin = time.perf_counter()
        try:
            placed = placed_objects(self.at, rows, objects)
        except ShardError as error:
            raise ShardError(f"{part.source}: {error}") from None
        search = ArmSearch(self.described, self._solids_with(hand), self.tries)
        found = search(
            hand_targets(self.at, rows, placed),
            threads(self.workers),
            lambda done, reached: progress(done, f"{reached / max(done, 1):.0%} reached"),
        )
        columns = {
            "ok": found.code == 0,
            "code": found.code,
            "q_arm": found.q,
            "manipulability": found.manipulability,
            "object_pose": placed.astype(np.float32),
        } | ({"q_arm_approach": found.q_approach} if rows.table else {})
        seconds = time.perf_counter() - begin
        told = self.settings() | {"joints": [joint.name for joint in self.described.moving], "codes": CODES}
        added = {
            "physics": {f"reach_{name}": values for name, values in columns.items()},
            "protocol": json.dumps(told),
            "statistics": {"reach_reached": int(columns["ok"].sum()), "seconds_reach": seconds},
        }
        return Made(len(rows), (key, added))

    def _solids_with(self, hand: HandRecord) -> "ArmSolids":
        from lgrasp.reach.self_collision import ArmSolids, base_pieces

        if hand.sha256 not in self._solids:
            cut = cutter(self.cache, self.events)
            self._solids[hand.sha256] = ArmSolids(self.described, base_pieces(hand, cut), cut)
        return self._solids[hand.sha256]

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        """``arm``, ``tip``, ``joints``; ``results``: of each hand and object ``rows`` and how many of them are
        ``reached``, or what they lack (``no_posture``, ``no_way``, ``hits_table``, ``hits_itself``)."""
        results: dict[tuple[str, str], np.ndarray] = {}
        for path in outcome.paths:
            with ShardReader(path, invalid=False) as reader:
                code, index = reader.column("physics/reach_code"), reader.column("object_index")[:, 0]
                for number, record in enumerate(reader.objects()):
                    counts = results.setdefault(
                        (str(reader.attributes["hand"]), record.name), np.zeros(len(CODES), int)
                    )
                    counts += np.bincount(code[index == number], minlength=len(CODES))
        return {
            "arm": self.described.urdf.name,
            "tip": self.described.tip,
            "joints": [joint.name for joint in self.described.moving],
            "results": [
                {
                    "hand": hand,
                    "object": name,
                    "rows": int(counts.sum()),
                    **dict(zip(CODES, counts.tolist(), strict=True)),
                }
                for (hand, name), counts in results.items()
            ],
        }
