"""Train a one-object predictor: a network that completes views on random solids, one that draws grasps on shards."""

import time
from typing import ClassVar

import numpy as np
import torch

from lgrasp.engine.events import Made, Part, PartProgress
from lgrasp.geometry.poses import internal_poses
from lgrasp.geometry.rotations import motion_from_pose
from lgrasp.grasp.records import ObjectRecord
from lgrasp.hand.model import HandModel
from lgrasp.jobs.learn.network import NetworkJob, training_report
from lgrasp.jobs.requests.shards import GraspRequest
from lgrasp.jobs.scenes.shards import load_hand, read_parts
from lgrasp.learn.curve import LossCurve
from lgrasp.learn.diffuser.examples import SequenceSteps, make_net, unseen_objects
from lgrasp.learn.diffuser.features import mesh_centre
from lgrasp.learn.diffuser.senses import coarse_grid
from lgrasp.learn.diffuser.training import StepTrainer
from lgrasp.learn.grasp.completion import CompletionNet
from lgrasp.learn.grasp.completion_training import ViewSet, fit_completion, solid_views
from lgrasp.learn.grasp.examples import first_steps, grasp_examples
from lgrasp.learn.grasp.file import KIND, VERSION, Networks, predictor_bytes
from lgrasp.learn.grasp.solids import random_solids
from lgrasp.learn.grasp.views import draw_views

_LEAST = 64  # grasps to learn from


class GraspJob(GraspRequest, NetworkJob):
    """A one-object predictor; the report has the losses of both networks."""

    kind: ClassVar[tuple[str, int]] = (KIND, VERSION)

    @property
    def effort_steps(self) -> int:
        return self.params.completion_steps + self.params.steps

    def make(self, part: Part, progress: PartProgress) -> Made:
        p, alias, start = self.params, self.device_used.alias, time.perf_counter()
        hand, records, steps, views = self._examples()
        unseen = unseen_objects([record.sha256 for record in records], p.held_out, p.seed)
        seconds = {"reading": time.perf_counter() - start}
        state = torch.random.get_rng_state()
        torch.manual_seed(p.seed)
        completes = CompletionNet(p.channels).to(alias)
        torch.random.set_rng_state(state)
        start = time.perf_counter()
        solids = random_solids(p.seed, p.shapes, p.cloud, lambda made: progress(0, f"{made:,} of {p.shapes:,} solids"))
        seconds["solids"] = time.perf_counter() - start
        start = time.perf_counter()
        completion = LossCurve(p.completion_steps, lambda step, loss: progress(step, f"loss {loss:.3f}"))
        error = fit_completion(completes, solid_views(solids, alias), p, completion)
        seconds["completion"] = time.perf_counter() - start
        start = time.perf_counter()
        draws = make_net(hand, 1, p)
        examples = grasp_examples(hand.tree, steps, views, draws, completes, p)
        trainer = StepTrainer(draws, examples, unseen, p, alias)
        curve = trainer.fit(lambda step, loss: progress(p.completion_steps + step, f"loss {loss:.3f}"))
        seconds["training"] = time.perf_counter() - start
        names = (_names(records, ~unseen), _names(records, unseen))
        curves = {"completion": {"loss": completion.points}, "drawing": curve}
        report = training_report(hand.name, trainer, *names, seconds, curves) | {"completion_loss": error}
        made = Networks(trainer.kept, completes, p, hand.name, hand.sha256, self.key(), report)
        return Made(part.rows, predictor_bytes(made))

    def _examples(self) -> tuple[HandModel, list[ObjectRecord], SequenceSteps, ViewSet]:
        """The hand, objects, grasps and views.

        Raises:
            ConfigError: too few grasps.
        """
        p, device = self.params, self.device_used
        parts = read_parts(self.shards)
        hand, _ = load_hand(parts.values(), self.hand, self.cache, device)
        records, grids, views, rows = [], [], [], []
        for _, part in sorted(parts.items()):
            columns, record = part.joined(), part.record
            if not len(columns["q"]):
                continue
            centre = mesh_centre(record.vertices)
            pose = internal_poses(columns["T_hand_object"], centre)
            rows.append((pose, columns["q"][:, : hand.dofs], np.full(len(pose), len(records))))
            grids.append(coarse_grid(record.vertices, record.faces, closed=record.watertight, device=device.alias))
            rng = np.random.default_rng([p.seed, len(records)])
            centred = np.asarray(record.vertices, float) - centre
            views += draw_views(centred, record.faces, p.views, p.cloud, rng, device.alias)
            records.append(record)
        self.enough(sum(len(q) for _, q, _ in rows), "grasps", _LEAST)
        pose, q, number = (torch.as_tensor(np.concatenate(x)) for x in zip(*rows, strict=True))
        return (
            hand,
            records,
            first_steps(hand.tree, *motion_from_pose(pose), q, number),
            ViewSet(views, grids, device.alias),
        )


def _names(records: list[ObjectRecord], which: torch.Tensor) -> list[str]:
    return [record.name for record, there in zip(records, which.tolist(), strict=True) if there]
