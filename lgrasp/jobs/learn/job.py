"""Train a coarse predictor on shards, keep it in a file, measure it."""

import copy
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from lgrasp.engine.cache import Cache
from lgrasp.engine.events import Made, Part, PartProgress
from lgrasp.errors import ConfigError
from lgrasp.hand.model import HandModel
from lgrasp.jobs.learn.network import NetworkJob
from lgrasp.jobs.scenes.shards import load_hand, read_parts
from lgrasp.jobs.shard_inputs import object_of_shard
from lgrasp.learn.curve import LossCurve
from lgrasp.learn.examples import Examples, make_examples
from lgrasp.learn.network import CoarseNet
from lgrasp.learn.networks import network_bytes, open_network
from lgrasp.learn.params import LearnParams
from lgrasp.learn.training import Measured, Trainer, measure
from lgrasp.runtime.device import resolve_device

_MIN_GRASPS = 16  # grasps to learn from


class FitJob(NetworkJob):
    """A predictor of coarse grasps, trained on the grasps of shards: one file.

    The report compares mean energies on clouds that were not trained on: of the predictor trained on poses alone
    (``frozen``), of the same trained on poses as many steps more (``longer``), and of the jointly trained one
    (``joint``).
    """

    kind: ClassVar[tuple[str, int]] = ("coarse", 2)

    @property
    def effort_steps(self) -> int:
        return self.params.steps + self.params.joint_steps

    def make(self, part: Part, progress: PartProgress) -> Made:
        p, device = self.params, self.device_used.alias
        hand, train, held_out = read_examples(self.shards, self.hand, p, self.cache, device)
        self.enough(sum(len(e.q) for e in train), "grasps", _MIN_GRASPS)
        trainer = Trainer(hand, train, p, device=device)
        start = time.perf_counter()
        turn = len(train)
        poses = LossCurve(p.steps, lambda step, loss: progress(step, f"loss {loss:.3f}"), turn=turn)
        trainer.fit_poses(p.steps, p.rate, poses)
        seconds = {"poses": time.perf_counter() - start}
        report: dict[str, Any] = {"hand": hand.name, "objects": [e.model.name for e in train]}
        curves = {"poses": {"loss": poses.points}}
        report["frozen"] = energy_numbers(measure(trainer, held_out))
        if p.joint_steps:
            before = copy.deepcopy(trainer.net.state_dict())
            trainer.fit_poses(p.joint_steps, p.joint_rate)
            report["longer"] = energy_numbers(measure(trainer, held_out))
            trainer.net.load_state_dict(before)
            start = time.perf_counter()

            def told(step: int, energy: float) -> None:
                progress(p.steps + step, f"energy {energy:.3f}")

            joint = LossCurve(p.joint_steps, told, turn=turn)
            trainer.fit_jointly(joint)
            curves["joint"] = {"energy": joint.points}
            seconds["joint"] = time.perf_counter() - start
            report["joint"] = energy_numbers(measure(trainer, held_out))
            report["lowered"] = {
                name: 1.0 - report["joint"][name] / report["frozen"][name] for name in ("coarse", "unrolled")
            }
        report |= {"seconds": seconds, "curves": curves, "params": p.model_dump(mode="json")}
        return Made(part.rows, _bytes(trainer, hand, self.key(), report))


def load_predictor(path: Path) -> tuple[CoarseNet, dict[str, Any]]:
    """A predictor on the CPU, and its card: ``hand``, ``hand_sha256``, ``params``, ``report``, ``run_key``.

    Raises:
        ConfigError: no such file, or no predictor.
    """
    with open_network(path, *FitJob.kind) as (card, state):
        net = CoarseNet(state["lower"], state["upper"], LearnParams.model_validate(card["params"]))
        net.load_state_dict(state)
        return net, card


def energy_numbers(found: Measured) -> dict[str, Any]:
    """What a report says of energies."""
    return {"poses": found.poses, "coarse": found.coarse, "unrolled": found.unrolled}


def read_examples(
    shards: Sequence[Path], name: str | None, params: LearnParams, cache: Cache, device: str
) -> tuple[HandModel, list[Examples], list[Examples]]:
    """The hand; clouds to train on and others, with the grasps, object by object."""
    parts = read_parts(shards)
    found = resolve_device(device)
    hand, _ = load_hand(parts.values(), name, cache, found)
    sets: tuple[list[Examples], list[Examples]] = ([], [])
    for number, (_, part) in enumerate(sorted(parts.items())):
        rows = part.joined()
        if not len(rows["q"]):
            continue
        model = object_of_shard(cache, part.record, found)
        for which, (into, clouds) in enumerate(zip(sets, (params.clouds, params.held_out), strict=True)):
            rng = np.random.default_rng([params.seed, number, which])
            q = rows["q"][:, : hand.dofs]
            into.append(make_examples(hand, model, rows["T_hand_object"], q, params, rng, clouds, device))
    if not sets[0]:
        raise ConfigError(f"{', '.join(map(str, shards))}: no grasps to learn from")
    return hand, *sets


def _bytes(trainer: Trainer, hand: HandModel, key: str, report: dict[str, Any]) -> bytes:
    """The file of a predictor."""
    card: dict[str, Any] = {
        "kind": FitJob.kind[0],
        "version": FitJob.kind[1],
        "hand": hand.name,
        "hand_sha256": hand.sha256,
    }
    card |= {"params": trainer.params.model_dump(mode="json"), "run_key": key, "report": report}
    return network_bytes(card, {name: values.cpu() for name, values in trainer.net.state_dict().items()})
