"""Train a network that draws steps of sequences on shards of these."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch

from lgrasp.engine.cache import Cache
from lgrasp.engine.events import Made, Part, PartProgress
from lgrasp.jobs.learn.network import NetworkJob, training_report
from lgrasp.jobs.learn.sequences import read_steps
from lgrasp.jobs.requests.shards import DiffuserRequest
from lgrasp.jobs.scenes.shards import check_hand
from lgrasp.learn.diffuser.examples import StepExamples, make_net
from lgrasp.learn.diffuser.file import KIND, VERSION, AboutDiffuser, diffuser_bytes, load_diffuser
from lgrasp.learn.diffuser.process import PROCESSES
from lgrasp.learn.diffuser.sampler import draw_steps
from lgrasp.learn.diffuser.senses import HeldObjects, Senses, sense_points
from lgrasp.learn.diffuser.training import StepTrainer, mean_loss
from lgrasp.learn.networks import SHARDS, check_network_hand
from lgrasp.runtime.device import resolve_device

_MIN_STEPS = 64  # of sequences, to learn from
_DRAWS, _POINTS = 1024, 48  # draws that are evaluated; points of each body of the hand, for penetration


class DiffuserJob(DiffuserRequest, NetworkJob):
    """A network that draws steps of sequences; the report has its losses on steps that it saw and that it did not."""

    kind: ClassVar[tuple[str, int]] = (KIND, VERSION)

    def make(self, part: Part, progress: PartProgress) -> Made:
        p, start = self.params, time.perf_counter()
        found = read_steps(self.shards, self.cache, p.cloud)
        check_hand(found.hand, self.hand, "the sequences")
        unseen = self.hold_out(found.meshes, found.steps, "steps", _MIN_STEPS)
        hand, net = found.hand, make_net(found.hand, len(found.space_names), p)
        examples = StepExamples(hand.tree, found.steps, found.clouds, found.grids, net, p, self.device_used.alias)
        trainer = StepTrainer(net, examples, unseen, p, self.device_used.alias)
        read = time.perf_counter() - start
        curve = trainer.fit(training := self.training(progress))
        seconds = {"reading": read, "training": training.seconds["drawing"]}
        report = training_report(hand.name, trainer, found.object_names, unseen, seconds, {"drawing": curve})
        about = AboutDiffuser(hand.name, hand.sha256, found.space_names, p, self.key(), report)
        return Made(part.rows, diffuser_bytes(trainer.kept, about), kept=training.resumed)


def evaluate(
    path: Path, shards: Sequence[Path], cache: Cache, *, seed: int = 1, device: str = "auto"
) -> dict[str, Any]:
    """How a network does on the steps of shards, which may be of objects that it was not trained on.

    Returns:
        ``hand``, ``objects``, ``unknown`` (those that it was not trained on), ``examples``; ``loss``; of ``draws``
        draws as they come, one for each of as many steps: ``penetration_median`` and ``penetration_mean`` of points of
        the hand in what it grasps and holds [mm, at most 20], ``touching`` (share of them in which both the object is
        less than 2 mm from the hand and nothing deeper than 2 mm), and the same ``of_data``; ``seconds_per_256`` draws.

    Raises:
        ConfigError: the file is no such network, or of another hand than the shards.
        LgraspError: shards cannot be used.
    """
    net, about = load_diffuser(path)
    used, p = resolve_device(device), about.params
    found = read_steps(shards, cache, p.cloud)
    digest = found.hand.sha256 if found.space_names == about.space_names else ""
    check_network_hand(path, about.hand, about.hand_sha256, found.hand.name, digest, words=SHARDS)
    net = net.to(used.alias).eval()
    examples = StepExamples(found.hand.tree, found.steps, found.clouds, found.grids, net, p, used.alias)
    every, process = torch.arange(len(examples), device=net.mean.device), PROCESSES[p.process]
    draw = torch.Generator().manual_seed(seed)
    rows = every[torch.randperm(len(examples), generator=draw)[:_DRAWS].to(every.device)]
    turn = torch.randint(len(examples.turns), (len(rows),), generator=draw).to(every.device)
    noise = torch.randn(len(rows), len(net.mean), generator=draw).to(every.device)
    (R, t, q), seen = examples.batch(rows, turn)

    def drawn(some: slice) -> tuple[torch.Tensor, ...]:
        given = seen.rows(some), noise[some], examples.turns[turn[some]], examples.steps.object[rows[some]]
        return draw_steps(net, process, examples.senses, *given, examples.held_objects(rows[some]), 10)

    dense = Senses(
        found.hand.tree, sense_points(found.hand, _POINTS).to(every.device), net.held_basis, found.grids, used.alias
    )

    def measured(R: torch.Tensor, t: torch.Tensor, q: torch.Tensor) -> dict[str, float]:
        held = examples.held_objects(rows)
        parts = [
            dense.distances(R[i], t[i], q[i], examples.steps.object[rows[i]], HeldObjects(*(x[i] for x in held)))
            for i in torch.arange(len(rows), device=every.device).split(256)
        ]
        own, other = (torch.cat(x).amin(1) for x in zip(*parts, strict=True))
        depth = (-1e3 * own.minimum(other)).clamp(0, 20)
        touching = (own < 0.002) & (depth < 2)
        shares = {
            "penetration_median": depth.median(),
            "penetration_mean": depth.mean(),
            "touching": touching.float().mean(),
        }
        return {name: float(value) for name, value in shares.items()}

    drawn(slice(0, 256))  # compiled and allocated now
    float(noise.sum())
    start = time.perf_counter()
    float(drawn(slice(0, 256))[1].sum())
    seconds = time.perf_counter() - start
    parts = zip(*(drawn(slice(i, i + 256)) for i in range(0, len(rows), 256)), strict=True)
    return {
        "hand": about.hand,
        "objects": sorted(set(found.object_names)),
        "unknown": sorted(set(found.object_names) - set(about.report.get("objects", ()))),
        "examples": len(examples),
        "loss": mean_loss(net, examples, every, process),
        "draws": len(rows),
        **measured(*(torch.cat(x) for x in parts)),
        "of_data": measured(R @ examples.turns[turn], t, q),
        "seconds_per_256": seconds * 256 / min(256, len(rows)),
    }
