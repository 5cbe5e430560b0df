"""What coarse predictions are worth: their energies, and how many grasps a local search makes of them."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.engine.cache import Cache
from lgrasp.geometry.rotations import inverse_motion, pose_from_motion
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.check import check_grasps
from lgrasp.grasp.find_contacts import find_contacts
from lgrasp.grasp.outcomes import Outcome
from lgrasp.grasp.tables import GraspTable
from lgrasp.hand.arrays import HandArrays, upload_hand
from lgrasp.jobs.learn.job import energy_numbers, load_predictor, read_examples
from lgrasp.jobs.requests.shards import refine_params
from lgrasp.learn.network import Coarse
from lgrasp.learn.networks import SHARDS, check_network_hand
from lgrasp.learn.params import LearnParams
from lgrasp.learn.training import ANSWERS, Trainer, measure
from lgrasp.object.arrays import upload_object
from lgrasp.object.model import ObjectModel
from lgrasp.refine.improve import improve
from lgrasp.refine.refiner import Refiner
from lgrasp.runtime.device import resolve_device

ROUNDS = (3, 6, 10, 13)
"""Outer steps of the refiner that the published table has."""


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
    hand, examples, _ = read_examples(shards, None, params.model_copy(update={"held_out": 1}), cache, alias)
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
    pose = pose_from_motion(*inverse_motion(coarse.R, coarse.t)).cpu().numpy()
    q, obj, search = coarse.q.cpu().numpy(), upload_object(model, hand.device), refine_params(coarse=True)
    alone = check_grasps(hand, obj, pose, q, find_contacts(hand, obj, pose, q, bounds), bounds)
    descent = Refiner(hand.model, model, search, device=hand.device).search
    index, tries = np.arange(len(q)), np.full(len(q), search.tries)
    return alone, improve(descent, hand, obj, pose, q, bounds, tries=tries, index=index)


def _valid(names: list[str], found: Sequence[tuple[GraspTable, np.ndarray]]) -> dict[str, Any]:
    epsilon = [table.metrics["epsilon"][outcome == Outcome.KEPT] for table, outcome in found]
    by_object = {name: _counted(own) for name, own in zip(names, epsilon, strict=True)}
    return _counted(np.concatenate(epsilon)) | {"objects": by_object}


def _counted(epsilon: np.ndarray) -> dict[str, Any]:
    """Of valid rows."""
    n = len(epsilon)
    return {"valid": n, "force_closure": int((epsilon > 0).sum()), "epsilon": float(epsilon.mean()) if n else None}
