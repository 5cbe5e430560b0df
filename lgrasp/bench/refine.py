"""The tables of DiPGrasp for our hands and objects: plans on meshes and noisy clouds, coarse poses refined."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
import trimesh

from lgrasp.bench.page import Page, Table, caveats, load_published, number, over
from lgrasp.cloud.model import cloud_object
from lgrasp.dataset import GraspRows, HandRecord
from lgrasp.engine.cache import Cache
from lgrasp.engine.inputs import load_object, object_key
from lgrasp.geometry.decompose import decompose
from lgrasp.geometry.rotations import so3_exp
from lgrasp.grasp.rows import grasp_rows, press
from lgrasp.grasp.tables import GraspTable
from lgrasp.hand.arrays import upload_hand
from lgrasp.hand.model import HandModel
from lgrasp.hand.surface import ContactSurface
from lgrasp.hand.surface_visibility import visible_surface
from lgrasp.jobs.records import hand_record, mesh_blobs, object_record
from lgrasp.jobs.refine.settings import COARSE
from lgrasp.jobs.shard_inputs import named_hand
from lgrasp.object.model import ObjectModel
from lgrasp.object.params import ObjectParams
from lgrasp.planning.planner import Planner, PlanParams, cloud_params
from lgrasp.planning.starts import STAND_OFF
from lgrasp.refine.refiner import Pose, Refiner, table_pose
from lgrasp.refine.surface import hand_surface
from lgrasp.runtime.device import Device, resolve_device
from lgrasp.simulate.protocol import find_protocol
from lgrasp.simulate.run import verdicts
from lgrasp.simulate.scene import Scene, scene_of

NOISES = (0.0, 0.002, 0.005, 0.01)
"""Standard deviations of the points of clouds, besides meshes [m]."""
STEPS = (0, 3, 6, 10, 13)
"""Rounds of matching after which the energy is measured."""

ONE = {"rolls": 1, "tilts": (0.0,), "finalists": 1}
"""Changes of the planner's parameters that leave one hand at each start, along the normal, as published."""
_POINTS = 6000
_SHIFT, _TURN, _BEND = 0.01, 0.15, 0.15  # standard deviations of a coarse pose [m, rad] an axis, [rad] a joint


@dataclass(frozen=True)
class _Case:
    """One object."""

    model: ObjectModel
    scene: Scene


@dataclass
class _Total:
    """Plans over some objects."""

    starts: int = 0
    planned: int = 0
    seconds: float = 0.0
    epsilon: list[np.ndarray] = field(default_factory=list)

    def result(self) -> dict[str, Any]:
        epsilon = np.concatenate([np.zeros(0), *self.epsilon])
        return {
            "starts": self.starts,
            "planned": self.planned,
            "valid": len(epsilon),
            "share": len(epsilon) / max(self.starts, 1),
            "epsilon": float(epsilon.mean()) if len(epsilon) else None,
            "seconds": self.seconds,
            "seconds_each": over(self.seconds, len(epsilon)),
        }


def bench_hands(
    hands: Sequence[str],
    objects: Sequence[str],
    starts: int,
    protocol: str = "fc",
    *,
    noises: Sequence[float] = NOISES,
    device: str = "auto",
    cache: Cache | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Plan and refine with some hands.

    Tables I and IV: ``starts`` on each object, on its mesh and for each noise on points of its surface with the normals
    of the clean surface, once with one hand at each start and once with the best of several. A plan is valid when it
    holds the true object under the protocol. Table III: the valid plans on meshes, displaced as a network would
    (1 cm and 0.15 rad an axis, 0.15 rad a joint), refined by ``COARSE``.

    Returns:
        What was asked; ``published``; ``best_of``, the hands at a start; and for each hand ``planning`` (``mesh`` or
        ``cloud_N_mm`` -> ``one`` and ``best`` -> starts, planned, valid, share, epsilon (mean of the valid), seconds,
        seconds_each (per valid plan)), ``energy`` (mean E* of coarse poses after ``steps`` rounds of matching),
        ``milliseconds`` (of one pose there, all side by side) and ``poses``.

    Raises:
        LgraspError: hand, object, device or protocol are unknown.
    """
    find_protocol(protocol)
    store, at = cache or Cache(), resolve_device(device)
    return {
        "device": at.name,
        "objects": list(objects),
        "starts": starts,
        "protocol": protocol,
        "best_of": PlanParams().rolls,
        "steps": list(STEPS),
        "published": load_published("dipgrasp").model_dump(mode="json"),
        "hands": {hand: _bench_hand(hand, objects, starts, protocol, noises, at, store, progress) for hand in hands},
    }


def _bench_hand(
    hand: str,
    objects: Sequence[str],
    starts: int,
    protocol: str,
    noises: Sequence[float],
    at: Device,
    cache: Cache,
    progress: Callable[[str], None],
) -> dict[str, Any]:
    source, model = named_hand(cache, hand, at)
    arrays, palmar = upload_hand(model, at.alias), visible_surface(source, model, at.alias)
    record = hand_record(model, mesh_blobs(source.urdf))
    stand_off = source.spec.stand_off or STAND_OFF
    totals = {(noise, hands): _Total() for noise in (None, *noises) for hands in ("one", "best")}
    coarse: list[tuple[ObjectModel, Pose]] = []
    for name in objects:
        case = _case(name, record, cache, at.alias)
        for (noise, hands), total in totals.items():
            target = case.model if noise is None else _cloud(case.model, noise)
            params = PlanParams(**ONE) if hands == "one" else PlanParams()
            params = params if noise is None else cloud_params(params)
            planner = Planner(arrays, target, stand_off, params, palmar)
            if not any(t.starts for t in totals.values()):
                planner.run(1)  # kernels are compiled outside of the clock
            begin = time.perf_counter()
            grasps, counts = planner.run(starts)
            seconds = time.perf_counter() - begin
            rows = grasp_rows(press(grasps), model.tree, target.center)
            holds = _holds(protocol, case.scene, rows) if len(grasps) else np.zeros(0, bool)
            what = f"{hand}, {name}, {_named(noise)}, {'one hand' if hands == 'one' else f'best of {params.rolls}'}"
            progress(f"{what}: {int(holds.sum())} of {starts}, {seconds:.1f} s")
            total.starts += counts["starts"]
            total.planned += len(grasps)
            total.seconds += seconds
            total.epsilon.append(grasps.metrics["epsilon"][holds])
            if noise is None and hands == "best":
                coarse.append((case.model, _displaced(grasps, holds, at.alias)))
    energy, milliseconds, poses = _falls(arrays.model, palmar, coarse, at.alias)
    planning: dict[str, dict[str, Any]] = {}
    for (noise, hands), total in totals.items():
        planning.setdefault(_named(noise), {})[hands] = total.result()
    return {"planning": planning, "energy": energy, "milliseconds": milliseconds, "poses": poses}


def _named(noise: float | None) -> str:
    return "mesh" if noise is None else f"cloud_{1e3 * noise:g}_mm"


def _case(name: str, record: HandRecord, cache: Cache, device: str) -> _Case:
    mesh, key = object_key(name, 1.0, ObjectParams())
    model, _ = load_object(cache, mesh, key, 1.0, ObjectParams(), device)
    return _Case(model, scene_of(record, [object_record(model)], partial(decompose, store=cache), device))


def _holds(protocol: str, scene: Scene, rows: GraspRows) -> np.ndarray:
    found = verdicts(scene, rows, find_protocol(protocol), threads=os.cpu_count() or 1)
    return found[f"{protocol}_holds"].astype(bool)


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
    published, starts = result["published"], result["starts"]
    head = [
        f"{result['device']}: {starts} starts on each of {', '.join(result['objects'])}; valid by {result['protocol']}"
    ]
    columns = ("hand", "whose", "epsilon", "valid", "s each", "planned")
    tables = [Table("Table I: plans on meshes", columns, _plans(result), 2)]
    columns = ("hand", "whose", *map(str, result["steps"]), "falls", "ms")
    tables.append(Table("Table III: energy of coarse poses after rounds of matching", columns, _energies(result), 2))
    clouds = [name for one in result["hands"].values() for name in one["planning"] if name != "mesh"]
    if clouds:
        names = tuple(dict.fromkeys(clouds))
        columns = ("hand", "whose", *(name[6:].replace("_", " ") for name in names), "kept", "s each")
        rows = [row for hand in result["hands"] for row in _noisy(result, hand, names)]
        tables.append(Table("Table IV: valid plans on points of the surface, by noise", columns, rows, 2))
    return Page(head, tables, caveats(published))


def _whose(result: dict[str, Any]) -> dict[str, str]:
    return {"one": "ours, one hand", "best": f"ours, best of {result['best_of']}"}


def _plans(result: dict[str, Any]) -> list[tuple[str, ...]]:
    rows = []
    for hand, one in result["hands"].items():
        for hands, whose in _whose(result).items():
            plans = one["planning"]["mesh"][hands]
            planned = f"{plans['planned'] / max(plans['starts'], 1):.1%}"
            rows.append((hand, whose, *_plan(plans["epsilon"], plans["share"], plans["seconds_each"]), planned))
            if hands == "one" and (paper := result["published"]["figures"].get(hand)):
                rows.append((hand, "paper", *_plan(paper["epsilon"], paper["valid"][0], paper["seconds"][0]), "-"))
    return rows


def _plan(epsilon: float | None, share: float, seconds: float | None) -> tuple[str, str, str]:
    return number(epsilon, ".3f"), f"{share:.1%}", number(seconds, ".2g")


def _energies(result: dict[str, Any]) -> list[tuple[str, ...]]:
    rows = []
    for hand, one in result["hands"].items():
        energy, paper = one["energy"], result["published"]["figures"].get(hand)
        ours = (f"ours, {one['poses']} poses", *(f"{e:.4f}" for e in energy))
        rows.append((hand, *ours, number(over(energy[0], energy[-1]), ".1f", "x"), f"{one['milliseconds'][-1]:.1f}"))
        if paper:
            energy = paper["energy"]
            rows.append((hand, "paper", *(f"{e:.0f}" for e in energy), f"{energy[0] / energy[-1]:.1f}x", "-"))
    return rows


def _noisy(result: dict[str, Any], hand: str, names: Sequence[str]) -> list[tuple[str, ...]]:
    def row(whose: str, shares: list[float], seconds: float | None) -> tuple[str, ...]:
        kept = number(over(shares[-1], shares[0]), ".0%")
        return (hand, whose, *(f"{share:.1%}" for share in shares), kept, number(seconds, ".2g"))

    rows, planning = [], result["hands"][hand]["planning"]
    for hands, whose in _whose(result).items():
        plans = [planning[name][hands] for name in names]
        rows.append(row(whose, [p["share"] for p in plans], plans[-1]["seconds_each"]))
        paper = result["published"]["figures"].get(hand)
        if hands == "one" and paper and len(paper["valid"]) == len(names):
            rows.append(row("paper", paper["valid"], paper["seconds"][-1]))
    return rows
