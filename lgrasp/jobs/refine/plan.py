"""The job of ``lgrasp plan``: a hand before an object or a cloud -> one shard of grasps."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from lgrasp.cloud.model import cloud_object
from lgrasp.cloud.read import Cloud
from lgrasp.dataset import ObjectRecord, Shard, ShardHeader, write_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.folder import check_folder, clean_folder, shard_path
from lgrasp.errors import ConfigError, OutputError
from lgrasp.grasp.rows import grasp_rows, press
from lgrasp.grasp.tables import GraspTable
from lgrasp.hand.arrays import upload_hand
from lgrasp.jobs.records import hand_config, hand_record, mesh_blobs, object_record
from lgrasp.jobs.shard_inputs import named_hand, named_object
from lgrasp.object.model import ObjectModel
from lgrasp.planning.planner import Planner, PlanParams, cloud_params
from lgrasp.planning.starts import STAND_OFF
from lgrasp.refine.visible_surface import seen_palmar
from lgrasp.runtime.device import resolve_device

_REACH = 0.3  # [m] what is farther from the target than this is no hand's business
_LEAST_AROUND = 50
_FARTHEST = 1.0  # [m] of a base from a start


@dataclass(frozen=True)
class PlanJob:
    """On what and where; an object or a cloud."""

    hand: str
    out: Path | None = None  # none: plans/HAND-OBJECT
    starts: int = 80
    object: str | None = None
    scale: float = 1.0
    cloud: Cloud | None = None
    cloud_name: str = "cloud"
    stand_off: float | None = None  # [m]; none: the hand's
    params: PlanParams = field(default_factory=PlanParams)
    device: str = "auto"
    force: bool = False
    cache: Cache = field(default_factory=Cache)


@dataclass(frozen=True)
class PlanOutcome:
    """What came of it."""

    path: Path | None  # none: no plan passed, no file
    hand: str
    object: ObjectModel
    grasps: GraspTable
    counts: dict[str, int]
    seconds: float  # of the planning


def plan_grasps(job: PlanJob, progress: Callable[[int, int], None] | None = None) -> PlanOutcome:
    """Plan grasps and write those that passed every check, a row a start, as one shard.

    Of a cloud the shard has the target's points as they were given, with their normals, as an object without faces.

    Args:
        progress: called with (starts done, plans); what it raises ends the job, and no file is written.

    Raises:
        ConfigError: neither or both of object and cloud, no start, a distance or weights out of range.
        OutputError: the shard exists already, or its folder cannot be written.
        LgraspError: hand, object or cloud cannot be used.
    """
    if (job.object is None) == (job.cloud is None):
        raise ConfigError("plan needs an object or a cloud, one of the two")
    if job.starts < 1:
        raise ConfigError(f"--starts {job.starts}: at least 1")
    if job.stand_off is not None and not 0 < job.stand_off <= _FARTHEST:
        raise ConfigError(f"--stand-off {job.stand_off:g}: more than 0 and at most {_FARTHEST:g} m is accepted")
    if not job.params.distal + job.params.other > 0:
        raise ConfigError("--distal 0 --other 0: nothing pulls the hand to the object; give one of them a weight")
    device = resolve_device(job.device)
    source, hand = named_hand(job.cache, job.hand, device)
    stand_off = job.stand_off or source.spec.stand_off or STAND_OFF
    around = None
    if job.cloud is not None:
        model, around = _cloud_models(job.cloud, job.cloud_name)
    else:
        assert job.object is not None
        model = named_object(job.cache, job.object, job.scale, device)
    out = job.out or Path("plans") / f"{hand.name}-{model.name}"
    path = shard_path(out, hand.name, model.name, 0)
    check_folder(out)
    if path.exists() and not job.force:
        raise OutputError(f"{path} exists; choose another folder with --out, or --force to replace it")
    clean_folder([path])
    palmar = seen_palmar(source, hand, device.alias)
    params = job.params if job.cloud is None else cloud_params(job.params)
    planner = Planner(upload_hand(hand, device.alias), model, stand_off, params, palmar, around)
    begin = time.perf_counter()
    grasps, counts = planner.run(job.starts, progress)
    seconds = time.perf_counter() - begin
    if len(grasps):
        header = ShardHeader(
            pipeline="plan",
            seed=0,
            shard_index=0,
            config={
                "bounds": params.bounds.describe(),
                "plan": params.model_dump(mode="json"),
                "starts": job.starts,
                "stand_off": stand_off,
                **hand_config(source),
            },
        )
        record = hand_record(hand, mesh_blobs(source.urdf))
        statistics = {"device": device.name, "seconds_wall": seconds}
        statistics |= {f"plan_{name.replace(' ', '_').replace('-', '_')}": n for name, n in counts.items()}
        rows = grasp_rows(press(grasps), hand.tree, model.center)
        write_shard(
            path,
            Shard(header=header, hand=record, objects=[_record(model, job.cloud)], grasps=rows, statistics=statistics),
        )
    return PlanOutcome(path if len(grasps) else None, hand.name, model, grasps, counts, seconds)


def _record(model: ObjectModel, cloud: Cloud | None) -> ObjectRecord:
    record = object_record(model)
    if cloud is None:
        return record
    target = cloud.only(cloud.target)
    normals = target.normals / np.linalg.norm(target.normals, axis=1, keepdims=True)
    return replace(record, vertices=target.points, normals=normals)


def _cloud_models(cloud: Cloud, name: str) -> tuple[ObjectModel, ObjectModel | None]:
    """The target, and what stands around it, both in the target's internal frame."""
    target = cloud.only(cloud.target)
    model = cloud_object(target.points, target.normals, name=name)
    if cloud.target.all():
        return model, None
    rest = cloud.only(~cloud.target)
    near = (abs(rest.points - model.center) < model.extents.max() + _REACH).all(1)
    if near.sum() < _LEAST_AROUND:
        return model, None
    around = cloud_object(rest.points[near] - model.center, rest.normals[near], name="around", centred=False)
    return model, around
