"""The job of ``lgrasp plan``: a hand before an object or a cloud -> one shard of grasps."""

import time
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import InstanceOf, PrivateAttr

from lgrasp.cloud.model import cloud_object
from lgrasp.cloud.read import Cloud
from lgrasp.dataset.info import closure_share
from lgrasp.dataset.reader import ShardReader
from lgrasp.engine.cache import content_key
from lgrasp.engine.events import JobOutcome, Made, Part, PartProgress
from lgrasp.engine.folder import Found, shard_path
from lgrasp.engine.run import Job
from lgrasp.errors import LgraspError, StarvedError
from lgrasp.grasp.records import ObjectRecord, Shard, ShardHeader
from lgrasp.grasp.rows import grasp_rows, press
from lgrasp.hand.arrays import upload_hand
from lgrasp.hand.find import HandSource
from lgrasp.hand.model import HandModel
from lgrasp.jobs.clouds import cloud_record, cloud_to_grasp, network_key
from lgrasp.jobs.records import SURROUNDED, hand_config, hand_record, mesh_blobs, object_record
from lgrasp.jobs.refine.predicted import predicted_planner
from lgrasp.jobs.requests.plan import PlanRequest
from lgrasp.jobs.shard_inputs import mesh_hash, named_hand, named_object, palmar_side
from lgrasp.learn.grasp.file import Networks, load_networks
from lgrasp.learn.networks import check_network_hand, find_network
from lgrasp.notices import notice
from lgrasp.object.model import ObjectModel
from lgrasp.planning.params import PlanParams, cloud_params
from lgrasp.planning.planner import Planner
from lgrasp.planning.starts import STAND_OFF

VERSION = 12
"""Raised whenever plans change for the same parameters."""

_OBSTACLE_REACH = 0.3  # [m] what is farther from the target than this is not in the hand's way
_LEAST_AROUND = 32  # points


class PlanJob(PlanRequest, Job):
    """Plans of grasps of an object or of a cloud: one shard of those that passed every check, a row a start.

    Of a cloud the shard has the target's points as they were given, with their normals, as an object without faces.
    """

    command: ClassVar[str] = "plan"
    kernels: ClassVar[tuple[str, ...]] = ("lgrasp.refine.", "lgrasp.grasp.")

    cloud: Path | InstanceOf[Cloud] | None = None
    _cloud: Cloud | None = PrivateAttr(None)

    @property
    def name(self) -> str:
        return "cloud" if isinstance(self.cloud, Cloud) else super().name

    @property
    def folder(self) -> Path:
        source, _, model, _ = self._models
        return self.out or Path("plans") / f"{source.name}-{model.name}"

    def key(self) -> str:
        _, hand, model, around = self._models
        record = self._record()
        normals = None if record.normals is None else np.asarray(record.normals, np.float32).tobytes().hex()
        rest = None if around is None else np.asarray(around.contact_points, np.float32).tobytes().hex()
        told = self._told() | {"params": self._params().model_dump(mode="json"), "keep_invalid": self.keep_invalid}
        seen = [model.name, mesh_hash(record), normals, rest]
        return content_key("plan", VERSION, hand=hand.sha256, object=seen, **told)

    def parts(self) -> list[Part]:
        source, _, model, _ = self._models
        return [Part(0, shard_path(self.folder, source.name, model.name, 0), self.starts)]

    def about(self) -> dict[str, Any]:
        source, _, model, _ = self._models
        return {"hand": source.name, "objects": [model.name]}

    def gave_up(self, rows: int, found: Found) -> bool:
        return found.tried >= rows

    def make(self, part: Part, progress: PartProgress) -> Made:
        source, hand, model, around = self._models
        touching, palmar = palmar_side(self.cache, source, hand)
        plan, arrays = self._params(), upload_hand(touching, self.device_used.alias)
        begin, networks = time.perf_counter(), self.networks
        if networks is None:
            planner = Planner(arrays, model, self._stand_off(), plan, palmar, around)
        else:
            planner = predicted_planner(networks, arrays, model, self.starts, plan, palmar, around)
        grasps, counts = planner.run(
            self.starts, lambda done, plans: progress(done, f"{plans:,} plans"), keep_invalid=self.keep_invalid
        )
        seconds = time.perf_counter() - begin
        config: dict[str, Any] = {
            "run_key": self.key(),
            "bounds": planner.effort.bounds.describe(),
            "plan": plan.model_dump(mode="json"),
        }
        config |= self._told() | hand_config(source) | ({} if around is None else {SURROUNDED: True})
        header = ShardHeader(pipeline="plan", seed=0, shard_index=0, config=config)
        statistics = {
            "device": self.device_used.name,
            "seconds_wall": seconds,
            "candidates": self.starts,
            "exhausted": 1,
            **{f"plan_{name.replace(' ', '_').replace('-', '_')}": n for name, n in counts.items()},
        }
        rows = grasp_rows(press(grasps), hand.tree, model.center)
        record = hand_record(hand, mesh_blobs(source.urdf))
        shard = Shard(header=header, hand=record, objects=[self._record()], grasps=rows, statistics=statistics)
        return Made(len(rows), shard, seconds)

    @cached_property
    def networks(self) -> Networks | None:
        """What draws the hands to start from, if something does.

        Raises:
            ConfigError: the file is none, or of another hand.
        """
        if self.model is None:
            return None
        path, (source, hand, _, _) = find_network(self.model), self._models
        found = load_networks(path)
        check_network_hand(path, found.hand, found.hand_sha256, source.name, hand.sha256)
        return found

    def _told(self) -> dict[str, Any]:
        """What keys and shards tell of the starts."""
        told = {"starts": self.starts, "stand_off": self._stand_off()}
        return told | ({"network": network_key(find_network(str(self.model)))} if self.networks else {})

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        """``grasps``, ``starts``, ``points`` (the object is a cloud), ``counts`` (what became of the starts), medians
        of ``epsilon`` and ``unresisted_load``, ``seconds_planning``, ``force_closure`` (share), ``valid`` by the bounds
        of ``profile``."""
        _, hand, model, _ = self._models
        data: dict[str, Any] = {"hand": hand.name, "object": model.name, "starts": self.starts, "grasps": outcome.rows}
        data |= {"points": self.cloud is not None, "profile": self.params.bounds.told}
        data |= {"force_closure": closure_share(outcome.paths), "seconds_planning": sum(outcome.results)}
        data |= {"counts": {}, "epsilon": None, "unresisted_load": None, "valid": 0}
        for path in outcome.paths:
            with ShardReader(path) as reader:
                statistics = reader.statistics
                if len(reader):
                    data["valid"] = int(reader.column("metrics/valid").sum())
                    data |= {n: float(np.median(reader.column(f"metrics/{n}"))) for n in ("epsilon", "unresisted_load")}
            told = {name.removeprefix("plan_"): n for name, n in statistics.items() if name.startswith("plan_")}
            data["counts"] = {name.replace("_", " "): n for name, n in told.items()}
        return data

    def shortfall(self, outcome: JobOutcome) -> LgraspError | None:
        if outcome.rows or not outcome.parts:
            return None
        lost = lost_starts(self.report(outcome)["counts"])
        hint = "; do its normals point out of it (--viewpoint), are there views of all sides?" if self.cloud else ""
        return StarvedError(f"no grasp planned from {self.starts} starts: {lost}{hint}")

    def _params(self) -> PlanParams:
        return self.params if self.cloud is None else cloud_params(self.params)

    def _stand_off(self) -> float:
        return self.stand_off or self._models[0].spec.stand_off or STAND_OFF

    @cached_property
    def _models(self) -> tuple[HandSource, HandModel, ObjectModel, ObjectModel | None]:
        """The hand, what is grasped, and what stands around it."""
        source, hand = named_hand(self.cache, self.hand)
        if self.cloud is None:
            assert self.object is not None
            return source, hand, named_object(self.cache, self.object, self.scale), None
        cloud = self.cloud
        if isinstance(cloud, Path):
            cloud = cloud_to_grasp(self.cache, cloud, self.mask, self.label, self.scale, self.viewpoint)
        self._cloud = cloud
        return source, hand, *_cloud_models(cloud, self.name)

    def _record(self) -> ObjectRecord:
        record = object_record(self._models[2])
        return record if self._cloud is None else cloud_record(record, self._cloud)


def lost_starts(counts: dict[str, int]) -> str:
    """Outcomes of the starts that gave no plan, in words."""
    return ", ".join(f"{n} {what}" for what, n in counts.items() if what not in ("starts", "kept") and n)


def _cloud_models(cloud: Cloud, name: str) -> tuple[ObjectModel, ObjectModel | None]:
    """The target, and what stands around it, both in the target's internal frame."""
    target = cloud.only(cloud.target)
    model = cloud_object(target.points, target.normals, name=name)
    if cloud.target.all():
        return model, None
    rest = cloud.only(~cloud.target)
    near = (abs(rest.points - model.center) < model.extents.max() + _OBSTACLE_REACH).all(1)
    if near.sum() < _LEAST_AROUND:
        if near.any():
            notice(f"{near.sum()} points near the target are too few for a surface and are not avoided")
        return model, None
    around = cloud_object(rest.points[near] - model.center, rest.normals[near], name="around", centred=False)
    return model, around
