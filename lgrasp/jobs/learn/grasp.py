"""Train a one-object predictor (a network that completes views on random solids, one that draws grasps on shards);
what its plans are worth on the true meshes of objects, from clouds of them."""

import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from lgrasp.cloud.model import cloud_object
from lgrasp.dataset.files import files_in
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import Made, Part, PartProgress
from lgrasp.engine.folder import shard_path
from lgrasp.errors import OutputError
from lgrasp.geometry.poses import internal_poses, user_poses
from lgrasp.geometry.rotations import motion_from_pose
from lgrasp.grasp.check import check_grasps
from lgrasp.grasp.find_contacts import find_contacts
from lgrasp.grasp.outcomes import Outcome
from lgrasp.grasp.records import ObjectRecord, Shard, ShardHeader
from lgrasp.grasp.rows import grasp_rows, press
from lgrasp.grasp.tables import GraspTable, join_rows
from lgrasp.hand.arrays import HandArrays, upload_hand
from lgrasp.hand.contact_surface import ContactSurface
from lgrasp.hand.find import HandSource
from lgrasp.hand.model import HandModel
from lgrasp.jobs.learn.network import NetworkJob, training_report
from lgrasp.jobs.records import hand_config, hand_record, mesh_blobs, object_record
from lgrasp.jobs.refine.predicted import predicted_planner
from lgrasp.jobs.requests.shards import GraspRequest
from lgrasp.jobs.scenes.shards import load_hand, read_parts
from lgrasp.jobs.shard_inputs import hand_of_shard, object_of_shard, palmar_side
from lgrasp.learn.diffuser.examples import SequenceSteps, make_net
from lgrasp.learn.diffuser.features import mesh_centre
from lgrasp.learn.diffuser.senses import coarse_grid
from lgrasp.learn.diffuser.training import StepTrainer
from lgrasp.learn.examples import seen_cloud
from lgrasp.learn.grasp.completion import CompletionNet, Cubes
from lgrasp.learn.grasp.completion_training import ViewSet, fit_completion, solid_views
from lgrasp.learn.grasp.examples import first_steps, grasp_examples
from lgrasp.learn.grasp.file import KIND, VERSION, Networks, load_networks, predictor_bytes
from lgrasp.learn.grasp.solids import SeenSolid, random_solids, solid_arrays, solids_of
from lgrasp.learn.grasp.views import SIDES, camera, draw_views
from lgrasp.learn.networks import SHARDS, check_network_hand
from lgrasp.object.arrays import upload_object
from lgrasp.object.model import ObjectModel
from lgrasp.planning.params import PlanParams, cloud_params
from lgrasp.runtime.device import resolve_device

KINDS = ("full", "one view")
"""Of clouds that are measured on."""

_LEAST = 64  # grasps to learn from
_SOLIDS = 256  # that are kept at a time


class GraspJob(GraspRequest, NetworkJob):
    """A one-object predictor; the report has the losses of both networks."""

    kind: ClassVar[tuple[str, int]] = (KIND, VERSION)
    steps: ClassVar[tuple[str, ...]] = ("completion_steps", "steps")

    def make(self, part: Part, progress: PartProgress) -> Made:
        p, alias, start = self.params, self.device_used.alias, time.perf_counter()
        hand, records, steps, views = self._examples()
        unseen = self.hold_out([record.sha256 for record in records], steps, "grasps", _LEAST)
        seconds = {"reading": time.perf_counter() - start}
        state = torch.random.get_rng_state()
        torch.manual_seed(p.seed)
        completes = CompletionNet(p.channels).to(alias)
        torch.random.set_rng_state(state)
        training = self.training(progress)
        completion = fit_completion(completes, lambda: self._cubes(progress), p, training).points
        draws = make_net(hand, 1, p)
        examples = grasp_examples(hand.tree, steps, views, draws, completes, p)
        trainer = StepTrainer(draws, examples, unseen, p, alias)
        curves = {"completion": {"loss": completion}, "drawing": trainer.fit(training)}
        seconds |= {"completion": training.seconds["completion"], "training": training.seconds["drawing"]}
        error = np.mean([loss for step, loss in completion if step > 0.9 * p.completion_steps])  # the last tenth's
        report = training_report(hand.name, trainer, [r.name for r in records], unseen, seconds, curves)
        report |= {"completion_loss": float(error)}
        made = Networks(trainer.kept, completes, p, hand.name, hand.sha256, self.key(), report)
        return Made(part.rows, predictor_bytes(made), kept=training.resumed)

    def made_before(self) -> list[str]:
        return list(self._parts())

    def _parts(self) -> dict[str, range]:
        """Numbers of the solids that are kept together, by name."""
        shapes = self.params.shapes
        return {f"solids {k}": range(k, min(k + _SOLIDS, shapes)) for k in range(0, shapes, _SOLIDS)}

    def _cubes(self, progress: PartProgress) -> tuple[Cubes, torch.Tensor]:
        """What completing is learnt from."""
        views = solid_views(self._solids(progress), self.device_used.alias)
        return views.cubes(self.params.nodes, lambda n: progress(0, f"{n:,} of {len(views.points):,} clouds"))

    def _solids(self, progress: PartProgress) -> list[SeenSolid]:
        p, parts = self.params, self._parts()
        there = {name for name in parts if self.has_kept(name)}
        missing = [number for name, numbers in parts.items() if name not in there for number in numbers]
        solids: list[SeenSolid] = []
        with closing(random_solids(p.seed, missing, p.cloud)) as makes:
            numbered = zip(missing, makes, strict=True)
            for name, numbers in parts.items():

                def make(numbers: range = numbers, damaged: bool = name in there) -> dict[str, np.ndarray]:
                    own = zip(numbers, random_solids(p.seed, numbers, p.cloud), strict=True) if damaged else numbered
                    found = []
                    for number, solid in own:
                        if number < numbers.start:  # of a part that another run made meanwhile
                            continue
                        found.append(solid)
                        progress(0, f"{number + 1:,} of {p.shapes:,} solids")
                        if len(found) == len(numbers):
                            break
                    return solid_arrays(found)

                solids += solids_of(self.kept(name, make))
        return solids

    def _examples(self) -> tuple[HandModel, list[ObjectRecord], SequenceSteps, ViewSet]:
        """The hand, objects, grasps and views."""
        p, device = self.params, self.device_used
        parts = read_parts(self.shards)
        hand, _ = load_hand(parts.values(), self.hand, self.cache)
        records, grids, views, rows = [], [], [], []
        for _, part in sorted(parts.items()):
            columns, record = part.joined(), part.record
            if not len(columns["q"]):
                continue
            centre = mesh_centre(record.vertices)
            pose = internal_poses(columns["T_hand_object"], centre)
            rows.append((pose, columns["q"][:, : hand.dofs], np.full(len(pose), len(records))))
            grids.append(coarse_grid(record.vertices, record.faces, closed=record.watertight))
            rng = np.random.default_rng([p.seed, len(records)])
            centred = np.asarray(record.vertices, float) - centre
            views += draw_views(centred, record.faces, p.views, p.cloud, rng, device.alias)
            records.append(record)
        if not rows:
            self.enough(0, "grasps", _LEAST)
        pose, q, number = (torch.as_tensor(np.concatenate(x)) for x in zip(*rows, strict=True))
        return (
            hand,
            records,
            first_steps(hand.tree, *motion_from_pose(pose), q, number),
            ViewSet(views, grids, device.alias),
        )


def evaluate(
    path: Path,
    shards: Sequence[Path],
    cache: Cache,
    *,
    clouds: int = 8,
    starts: int = 8,
    seed: int = 1,
    device: str = "auto",
    out: Path | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Plans from new clouds of the objects of shards, checked on the meshes; of each kind of cloud.

    Args:
        clouds: of each object and kind. starts: of each cloud.
        out: folder for the plans as rows of the meshes, for the simulator, by kind.

    Returns:
        ``hand``, ``unknown`` (objects that it was not trained on), ``kinds``, ``seconds``.

    Raises:
        ConfigError: the file is no predictor, or of another hand than the shards.
        OutputError: there are plans in the folder.
        LgraspError: shards cannot be used.
    """
    folders = {} if out is None else {kind: out / kind.replace(" ", "-") for kind in KINDS}
    there = [file for folder in folders.values() for file in files_in(folder)]
    if there and not overwrite:
        raise OutputError(f"{there[0]} is of an evaluation before; choose another --out, or --overwrite to replace it")
    found = resolve_device(device)
    networks, parts = load_networks(path), read_parts(shards)
    first = next(iter(parts.values()))
    source, hand = hand_of_shard(cache, first.hand, first.config)
    check_network_hand(path, networks.hand, networks.hand_sha256, hand.name, hand.sha256, words=SHARDS)
    touching, palmar = palmar_side(cache, source, hand)
    told = {"network": path.name, "run_key": networks.run_key, "clouds": clouds, "starts": starts}
    hand_on_device, params = upload_hand(touching, found.alias), cloud_params(PlanParams())
    bench = _Bench(networks, source, hand_on_device, palmar, starts, params, seed, told)
    begin = time.perf_counter()
    kinds: dict[str, Any] = {kind: {} for kind in KINDS}
    for number, (_, part) in enumerate(sorted(parts.items())):
        model = object_of_shard(cache, part.record)
        for which, kind in enumerate(KINDS):
            rng = np.random.default_rng([seed, number, which])
            table = join_rows([bench.plans(model, kind, rng, c) for c in range(clouds)])
            kinds[kind][model.name] = _numbers(table, clouds * starts)
            if out is not None:
                while there:
                    there.pop().unlink(missing_ok=True)
                bench.write(folders[kind], model, table)
    unknown = sorted({part.record.id for part in parts.values()} - set(networks.report.get("objects", ())))
    return {"hand": hand.name, "unknown": unknown, "kinds": kinds, "seconds": time.perf_counter() - begin}


@dataclass(frozen=True)
class _Bench:
    """A predictor, and what it is measured with."""

    networks: Networks
    source: HandSource
    hand: HandArrays
    palmar: ContactSurface
    starts: int
    params: PlanParams
    seed: int
    told: dict[str, Any]
    """What shards say of the evaluation."""

    def plans(self, model: ObjectModel, kind: str, rng: np.random.Generator, number: int) -> GraspTable:
        """Plans from a new cloud of a mesh as rows of it: checked there, with the control poses that were planned."""
        points = seen_cloud(model.vertices - model.center, model.faces, camera(SIDES[kind]), rng, self.hand.device)
        cloud = cloud_object(points.points.astype(float), points.normals)
        planner = predicted_planner(self.networks, self.hand, cloud, self.starts, self.params, self.palmar, seed=number)
        planned, _ = planner.run(self.starts)
        pose = internal_poses(user_poses(planned.pose, cloud.center), np.zeros(3))
        obj, bounds = upload_object(model, self.hand.device), self.params.bounds
        contacts = find_contacts(self.hand, obj, pose, planned.q, bounds, self.palmar)
        table, outcome = check_grasps(self.hand, obj, pose, planned.q, contacts, bounds)
        table.metrics["valid"] = (outcome == Outcome.KEPT).astype(np.float32)
        table.index[:] = number * self.starts + planned.index
        return replace(table, q_pregrasp=planned.q_pregrasp, q_squeeze=planned.q_squeeze)

    def write(self, folder: Path, model: ObjectModel, table: GraspTable) -> None:
        """Rows of one mesh as a shard."""
        hand = self.hand.model
        config = {"bounds": self.params.bounds.describe(), **hand_config(self.source), "learn_eval": self.told}
        header = ShardHeader(pipeline="plan", seed=self.seed, shard_index=0, config=config)
        record = hand_record(hand, mesh_blobs(self.source.urdf))
        rows = grasp_rows(press(table), hand.tree, model.center)
        shard = Shard(header=header, hand=record, objects=[object_record(model)], grasps=rows, statistics={})
        write_shard(shard_path(folder, hand.name, model.name, 0), shard)


def _numbers(table: GraspTable, asked: int) -> dict[str, Any]:
    """Of the plans of one mesh."""
    penetration = table.metrics["penetration"]
    return {
        "asked": asked,
        "delivered": len(table),
        "valid": int(table.metrics["valid"].sum()),
        "penetration": [float(x) for x in np.quantile(penetration, (0.5, 0.9))] if len(table) else None,
    }
