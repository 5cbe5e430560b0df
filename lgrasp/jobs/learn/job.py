"""Train a coarse predictor on shards, keep it in a file; what its predictions are worth: energies, and grasps."""

import copy
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from lgrasp.engine.cache import Cache
from lgrasp.engine.events import Made, Part, PartProgress
from lgrasp.errors import ConfigError
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.find_contacts import check_found
from lgrasp.grasp.outcomes import Outcome
from lgrasp.grasp.tables import GraspTable
from lgrasp.hand.arrays import HandArrays, upload_hand
from lgrasp.hand.model import HandModel
from lgrasp.jobs.learn.network import NetworkJob
from lgrasp.jobs.requests.shards import refine_params
from lgrasp.jobs.scenes.shards import load_hand, read_parts
from lgrasp.jobs.shard_inputs import object_of_shard
from lgrasp.learn.examples import Examples, make_examples
from lgrasp.learn.network import Coarse, CoarseNet
from lgrasp.learn.networks import SHARDS, check_network_hand, check_trained, network_bytes, open_network
from lgrasp.learn.params import LearnParams
from lgrasp.learn.training import ANSWERS, Measured, Trainer, measure
from lgrasp.object.arrays import upload_object
from lgrasp.object.model import ObjectModel
from lgrasp.refine.improve import improve
from lgrasp.refine.refiner import Refiner, object_pose
from lgrasp.runtime.device import resolve_device

ROUNDS = (3, 6, 10, 13)
"""Outer steps of the refiner that the published table has."""

_MIN_GRASPS = 16  # grasps to learn from


class FitJob(NetworkJob):
    """A predictor of coarse grasps, trained on the grasps of shards: one file.

    The report compares mean energies on clouds that were not trained on: of the predictor trained on poses alone
    (``frozen``), of the same trained on poses as many steps more (``longer``), and of the jointly trained one
    (``joint``).
    """

    kind: ClassVar[tuple[str, int]] = ("coarse", 2)
    steps: ClassVar[tuple[str, ...]] = ("steps", "joint_steps", "joint_steps")

    def make(self, part: Part, progress: PartProgress) -> Made:
        p, device = self.params, self.device_used.alias
        hand, train, held_out = read_examples(self.shards, self.hand, p, self.cache, device)
        self.enough(sum(len(e.q) for e in train), "grasps", _MIN_GRASPS)
        trainer = Trainer(hand, train, p, device=device)
        training = self.training(progress)
        poses = trainer.fit_poses(training, "poses", p.steps, p.rate)
        report: dict[str, Any] = {"hand": hand.name, "objects": [e.model.name for e in train]}
        curves = {"poses": {"loss": poses.points}}
        report["frozen"] = energy_numbers(measure(trainer, held_out))
        if p.joint_steps:
            before = copy.deepcopy(trainer.net.state_dict())
            trainer.fit_poses(training, "longer", p.joint_steps, p.joint_rate)
            report["longer"] = energy_numbers(measure(trainer, held_out))
            trainer.net.load_state_dict(before)
            curves["joint"] = {"energy": trainer.fit_jointly(training).points}
            report["joint"] = energy_numbers(measure(trainer, held_out))
            report["lowered"] = {
                name: 1.0 - report["joint"][name] / report["frozen"][name] for name in ("coarse", "unrolled")
            }
        seconds = {name: taken for name, taken in training.seconds.items() if name in curves}
        report |= {"seconds": seconds, "curves": curves, "params": p.model_dump(mode="json")}
        card: dict[str, Any] = dict(zip(("kind", "version"), self.kind, strict=True))
        card |= {"hand": hand.name, "hand_sha256": hand.sha256, "params": report["params"], "run_key": self.key()}
        weights = {name: values.cpu() for name, values in trainer.net.state_dict().items()}
        check_trained(weights)
        return Made(part.rows, network_bytes(card | {"report": report}, weights), kept=training.resumed)


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
    shards: Sequence[Path], name: str | None, params: LearnParams, cache: Cache, device: str, *, stream: int = 0
) -> tuple[HandModel, list[Examples], list[Examples]]:
    """The hand; clouds to train on and others, with the grasps, object by object.

    Args:
        stream: of random numbers: clouds of another have nothing in common, whatever the seed.
    """
    parts = read_parts(shards)
    hand, _ = load_hand(parts.values(), name, cache)
    sets: tuple[list[Examples], list[Examples]] = ([], [])
    for number, (_, part) in enumerate(sorted(parts.items())):
        rows = part.joined()
        if not len(rows["q"]):
            continue
        model = object_of_shard(cache, part.record)
        for which, (into, clouds) in enumerate(zip(sets, (params.clouds, params.held_out), strict=True)):
            rng = np.random.default_rng([params.seed, number, 2 * stream + which])
            q = rows["q"][:, : hand.dofs]
            into.append(make_examples(hand, model, rows["T_hand_object"], q, params, rng, clouds, device))
    if not sets[0]:
        raise ConfigError(f"{', '.join(map(str, shards))}: no grasps to learn from")
    return hand, *sets


def evaluate(
    path: Path, shards: Sequence[Path], cache: Cache, *, clouds: int = 8, seed: int = 1, device: str = "auto"
) -> dict[str, Any]:
    """A predictor's best answers for new clouds of the objects of shards, and what becomes of them.

    Returns:
        ``hand``, ``objects``, ``unknown`` (those that it was not trained on), ``poses``; mean energies ``coarse``,
        ``unrolled`` and ``refined``, after ``rounds`` of the refiner; of ``alone`` (as predicted) and ``searched`` (as
        ``lgrasp refine --coarse`` moves them) how many are ``valid`` by the bounds of ``profile``, how many of these
        have ``force_closure``, and their mean ``epsilon``, each also for every object; ``seconds``.

    Raises:
        ConfigError: the file is no predictor, or of another hand than the shards.
        LgraspError: shards cannot be used.
    """
    alias = resolve_device(device).alias
    net, saved = load_predictor(path)
    params = LearnParams.model_validate(saved["params"]).model_copy(update={"clouds": clouds, "seed": seed})
    hand, examples, _ = read_examples(shards, None, params.model_copy(update={"held_out": 1}), cache, alias, stream=1)
    check_network_hand(path, saved["hand"], saved["hand_sha256"], hand.name, hand.sha256, words=SHARDS)
    trainer, bounds = Trainer(hand, examples, params, device=alias), GraspBounds()
    trainer.net.load_state_dict(net.state_dict())
    start, arrays = time.perf_counter(), upload_hand(hand, alias)
    found = measure(trainer, examples, rounds=ROUNDS)
    names = [e.model.name for e in examples]
    made = [_grasps(arrays, e.model, trainer.predict(e, ANSWERS), bounds) for e in examples]
    alone, searched = (_valid(names, both) for both in zip(*made, strict=True))
    return {
        "hand": hand.name,
        "objects": names,
        "unknown": sorted(set(names) - set(saved["report"].get("objects", ()))),
        "rounds": list(ROUNDS),
        **energy_numbers(found),
        "refined": list(found.refined),
        "profile": bounds.profile,
        "alone": alone,
        "searched": searched,
        "seconds": time.perf_counter() - start,
    }


def _grasps(
    hand: HandArrays, model: ObjectModel, coarse: Coarse, bounds: GraspBounds
) -> tuple[tuple[GraspTable, np.ndarray], tuple[GraspTable, np.ndarray]]:
    """Answers as they are, and moved by a local search, each with what the checks find (Outcome, (n,))."""
    pose, q = object_pose(coarse.R, coarse.t), coarse.q.cpu().numpy()
    obj, search = upload_object(model, hand.device), refine_params(coarse=True)
    check = partial(check_found, hand, obj, bounds=bounds)
    descent = Refiner(hand.model, model, search, device=hand.device).search
    index, tries = np.arange(len(q)), np.full(len(q), search.tries)
    return check(pose, q), improve(descent, hand, check, pose, q, tries=tries, index=index)


def _valid(names: list[str], found: Sequence[tuple[GraspTable, np.ndarray]]) -> dict[str, Any]:
    epsilon = [table.metrics["epsilon"][outcome == Outcome.KEPT] for table, outcome in found]
    by_object = {name: _counted(own) for name, own in zip(names, epsilon, strict=True)}
    return _counted(np.concatenate(epsilon)) | {"objects": by_object}


def _counted(epsilon: np.ndarray) -> dict[str, Any]:
    """Of valid rows."""
    n = len(epsilon)
    return {"valid": n, "force_closure": int((epsilon > 0).sum()), "epsilon": float(epsilon.mean()) if n else None}
