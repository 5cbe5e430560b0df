"""The tables of DiPGrasp for our hands and objects: plans on meshes and noisy clouds, coarse poses refined."""

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from lgrasp.bench.page import Page, Table, caveats, check_once, load_published, over
from lgrasp.choices import EngineName
from lgrasp.cloud.model import cloud_object
from lgrasp.engine.cache import Cache
from lgrasp.engine.inputs import Loader, object_key
from lgrasp.geometry.rotations import so3_exp
from lgrasp.grasp.records import GraspRows
from lgrasp.grasp.rows import grasp_rows, press
from lgrasp.grasp.tables import GraspTable
from lgrasp.hand.arrays import upload_hand
from lgrasp.hand.contact_surface import ContactSurface
from lgrasp.hand.model import HandModel
from lgrasp.jobs.records import make_scene, mesh_blobs, object_record
from lgrasp.jobs.shard_inputs import named_hand, palmar_side
from lgrasp.object.model import ObjectModel
from lgrasp.object.params import ObjectParams
from lgrasp.planning.params import PlanParams, cloud_params
from lgrasp.planning.planner import Planner
from lgrasp.planning.starts import STAND_OFF
from lgrasp.refine.params import COARSE
from lgrasp.refine.refiner import Pose, Refiner, table_pose
from lgrasp.refine.surface import hand_surface
from lgrasp.runtime.cores import cores
from lgrasp.runtime.device import Device, resolve_device
from lgrasp.runtime.kept import Keeper
from lgrasp.simulate.protocol import find_protocol
from lgrasp.simulate.run import check_installed, verdicts
from lgrasp.simulate.scene import Scene
from lgrasp.words import number

NOISES = (0.0, 0.002, 0.005, 0.01)
"""Standard deviations of the points of clouds, besides meshes [m]."""
STEPS = (0, 3, 6, 10, 13)
"""Rounds of matching after which the energy is measured."""

ONE = {"rolls": 1, "tilts": (0.0,), "finalists": 1}
"""Changes of the planner's parameters that leave one hand at each start, along the normal, as published."""
_POINTS = 6000
_SHIFT, _TURN, _BEND = 0.01, 0.15, 0.15  # standard deviations of a coarse pose [m, rad] an axis, [rad] a joint


@dataclass
class _Total:
    """Plans over some objects."""

    starts: int = 0
    planned: int = 0
    seconds: float = 0.0
    epsilon: list[float] = field(default_factory=list)

    def result(self) -> dict[str, Any]:
        valid = len(self.epsilon)
        return {
            "starts": self.starts,
            "planned": self.planned,
            "valid": valid,
            "share": valid / max(self.starts, 1),
            "epsilon": float(np.mean(self.epsilon)) if valid else None,
            "seconds": self.seconds,
            "seconds_each": over(self.seconds, valid),
        }


def bench_hands(
    hands: Sequence[str],
    objects: Sequence[str],
    starts: int,
    protocol: str = "dipgrasp",
    *,
    engine: EngineName,
    params: PlanParams | None = None,
    noises: Sequence[float],
    device: str,
    cache: Cache | None,
    progress: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Plan and refine with some hands.

    Tables I and IV: ``starts`` on each object, on its mesh and for each noise on points of its surface with the normals
    of the clean surface, once with one hand at each start and once with the best of several. A plan is valid when it
    holds the true object under the protocol in the simulator. Table III: the valid plans on meshes, displaced as a
    network would (1 cm and 0.15 rad an axis, 0.15 rad a joint), refined by ``COARSE``.

    Returns:
        What was asked; ``published``; ``best_of``, the hands at a start; and for each hand ``planning`` (``mesh`` or
        ``cloud_N_mm`` -> ``one`` and ``best`` -> starts, planned, valid, share, epsilon (mean of the valid), seconds,
        seconds_each (per valid plan)), ``energy`` (mean E* of coarse poses after ``steps`` rounds of matching),
        ``milliseconds`` (of one pose there, all side by side) and ``poses``.

    Raises:
        LgraspError: hand, object, device or protocol are unknown, or the simulator is missing.
    """
    for what, names in (("hand", hands), ("object", objects)):
        check_once(what, [Path(name).stem for name in names])
    rules, best, kept = find_protocol(protocol).by(engine), params or PlanParams(), Keeper()
    check_installed("cpu", rules)
    store, at = cache or Cache(), resolve_device(device)
    planners = {
        (_named(noise), hands): (noise, own if noise is None else cloud_params(own))
        for noise in (None, *noises)
        for hands, own in (("one", best.model_copy(update=ONE)), ("best", best))
    }

    def judge(scene: Scene, rows: GraspRows) -> np.ndarray:
        found = verdicts(scene, rows, rules, threads=cores(), keep=kept.get)
        return found[f"{rules.name}_holds"].astype(bool)

    with closing(kept):
        found = {hand: _bench_hand(hand, objects, starts, judge, planners, at, store, progress) for hand in hands}
    return {
        "device": at.name,
        "objects": list(objects),
        "starts": starts,
        "protocol": rules.name,
        "best_of": best.rolls,
        "steps": list(STEPS),
        "published": load_published("dipgrasp").model_dump(mode="json"),
        "hands": found,
    }


def _bench_hand(
    hand: str,
    objects: Sequence[str],
    starts: int,
    judge: Callable[[Scene, GraspRows], np.ndarray],
    planners: dict[tuple[str, str], tuple[float | None, PlanParams]],
    at: Device,
    cache: Cache,
    progress: Callable[[str], None],
) -> dict[str, Any]:
    source, model = named_hand(cache, hand)
    touching, palmar = palmar_side(cache, source, model)
    arrays = upload_hand(touching, at.alias)
    meshes = mesh_blobs(source.urdf)
    stand_off = source.spec.stand_off or STAND_OFF
    totals = {name: _Total() for name in planners}
    coarse: list[tuple[ObjectModel, Pose]] = []
    for name in objects:
        mesh, key = object_key(name, 1.0, ObjectParams())
        found = Loader(cache).object(mesh, key, 1.0, ObjectParams())
        scene = make_scene(cache, model, [object_record(found)], meshes)
        for (on, hands), (noise, params) in planners.items():
            total, target = totals[on, hands], found if noise is None else _cloud(found, noise)
            planner = Planner(arrays, target, stand_off, params, palmar)
            if not any(t.starts for t in totals.values()):
                planner.run(1)  # kernels are compiled outside of the clock
            begin = time.perf_counter()
            grasps, counts = planner.run(starts)
            seconds = time.perf_counter() - begin
            holds = np.zeros(0, bool)
            if len(grasps):
                holds = judge(scene, grasp_rows(press(grasps), model.tree, target.center))
            what = f"{hand}, {name}, {on}, {'one hand' if hands == 'one' else f'best of {params.rolls}'}"
            progress(f"{what}: {int(holds.sum())} of {starts}, {seconds:.1f} s")
            total.starts += counts["starts"]
            total.planned += len(grasps)
            total.seconds += seconds
            total.epsilon += grasps.metrics["epsilon"][holds].tolist()
            if (on, hands) == ("mesh", "best"):
                coarse.append((found, _displaced(grasps, holds, at.alias)))
    energy, milliseconds, poses = _falls(arrays.model, palmar, coarse, at.alias)
    planning = {on: {hands: totals[on, hands].result() for hands in ("one", "best")} for on, _ in planners}
    return {"planning": planning, "energy": energy, "milliseconds": milliseconds, "poses": poses}


def _named(noise: float | None) -> str:
    return "mesh" if noise is None else f"cloud_{1e3 * noise:g}_mm"


def _cloud(model: ObjectModel, noise: float) -> ObjectModel:
    """Points of an object's surface, displaced, in the user's frame."""
    mesh = trimesh.Trimesh(model.vertices, model.faces, process=False)
    points, faces = trimesh.sample.sample_surface(mesh, _POINTS, seed=0)[:2]
    moved = points + np.random.default_rng(0).normal(size=points.shape) * noise
    return cloud_object(moved, np.asarray(mesh.face_normals)[faces], name=model.name)


def _displaced(table: GraspTable, holds: np.ndarray, device: str) -> Pose:
    """Coarse poses: valid plans and noise."""
    pose = table_pose(table, device)
    R, t, q = (x[torch.as_tensor(np.flatnonzero(holds), device=device)] for x in pose)
    noise = torch.randn(len(t), 6 + q.shape[1], generator=torch.Generator().manual_seed(0)).to(device)
    return Pose(so3_exp(_TURN * noise[:, :3]) @ R, t + _SHIFT * noise[:, 3:6], q + _BEND * noise[:, 6:])


def _falls(
    hand: HandModel, palmar: ContactSurface, coarse: list[tuple[ObjectModel, Pose]], device: str
) -> tuple[list[float], list[float], int]:
    """Mean energy of coarse poses, and the milliseconds of one, after STEPS outer steps; and their number."""
    surface = hand_surface(hand, palmar)
    energy, seconds, count = np.zeros(len(STEPS)), np.zeros(len(STEPS)), 0
    for model, pose in coarse:
        if len(pose.t) == 0:
            continue
        refiner = Refiner(hand, model, COARSE, surface=surface, device=device)
        count += len(pose.t)
        for k, steps in enumerate(STEPS):
            begin = time.perf_counter()
            found = refiner(*pose, rounds=steps).energies.total
            energy[k] += float(found.sum())
            seconds[k] += time.perf_counter() - begin
    each = max(count, 1)
    return (energy / each).tolist(), (1e3 * seconds / each).tolist(), count


def refine_page(result: dict[str, Any]) -> Page:
    """The tables as texts: the paper's figures stand beside one hand at each start."""
    starts, names, papers = result["starts"], ", ".join(result["objects"]), result["published"]["figures"]
    whose = {"one": "ours, one hand", "best": f"ours, best of {result['best_of']}"}
    plans, energies, noisy = [], [], []
    clouds = tuple(dict.fromkeys(n for one in result["hands"].values() for n in one["planning"] if n != "mesh"))
    for hand, one in result["hands"].items():
        paper, planning, energy = papers.get(hand), one["planning"], one["energy"]
        for hands, ours in whose.items():
            own = planning["mesh"][hands]
            planned = own["planned"] / max(own["starts"], 1), over(own["valid"], own["planned"])
            shares = (number(share, ".1%") for share in planned)
            plans.append((hand, ours, *_plan(own["epsilon"], own["share"], own["seconds_each"]), *shares))
            on_clouds = [planning[name][hands] for name in clouds]
            if clouds:
                noisy.append((hand, ours, *_noisy([p["share"] for p in on_clouds], on_clouds[-1]["seconds_each"])))
            if paper and hands == "one":
                plans.append(
                    (hand, "paper", *_plan(paper["epsilon"], paper["valid"][0], paper["seconds"][0]), "-", "-")
                )
                if clouds and len(paper["valid"]) == len(clouds):
                    noisy.append((hand, "paper", *_noisy(paper["valid"], paper["seconds"][-1])))
        fall, each = number(over(energy[0], energy[-1]), ".1f", "x"), f"{one['milliseconds'][-1]:.1f}"
        energies.append((hand, f"ours, {one['poses']} poses", *(f"{e:.4f}" for e in energy), fall, each))
        if paper:
            energy = paper["energy"]
            energies.append((hand, "paper", *(f"{e:.0f}" for e in energy), f"{energy[0] / energy[-1]:.1f}x", "-"))
    columns = {
        "Table I: plans on meshes": ("epsilon", "valid", "s each", "planned", "success"),
        "Table III: energy of coarse poses after rounds of matching": (*map(str, result["steps"]), "falls", "ms"),
        "Table IV: valid plans on points of the surface, by noise": (
            *(name[6:].replace("_", " ") for name in clouds),
            "kept",
            "s each",
        ),
    }
    tables = [
        Table(title, ("hand", "whose", *own), rows, 2)
        for (title, own), rows in zip(columns.items(), (plans, energies, noisy), strict=True)
        if rows
    ]
    head = f"{result['device']}: {starts} starts on each of {names}; valid by {result['protocol']}"
    return Page([head], tables, caveats(result["published"]))


def _plan(epsilon: float | None, share: float, seconds: float | None) -> tuple[str, str, str]:
    return number(epsilon, ".3f"), f"{share:.1%}", number(seconds, ".2g")


def _noisy(shares: list[float], seconds: float | None) -> tuple[str, ...]:
    kept = number(over(shares[-1], shares[0]), ".0%")
    return (*(f"{share:.1%}" for share in shares), kept, number(seconds, ".2g"))
