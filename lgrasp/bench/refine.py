"""The published tables of the local search, for our hands and objects: planning, refining, noise."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
import trimesh

from lgrasp.cloud.model import cloud_object
from lgrasp.dataset import GraspRows
from lgrasp.engine.cache import Cache
from lgrasp.engine.inputs import load_object, object_key
from lgrasp.geometry.decompose import decompose
from lgrasp.geometry.rotations import so3_exp
from lgrasp.grasp.tables import GraspTable
from lgrasp.hand.arrays import upload_hand
from lgrasp.jobs.records import hand_record, mesh_blobs, object_record
from lgrasp.jobs.refine.inputs import named_hand
from lgrasp.jobs.refine.rows import shard_rows
from lgrasp.jobs.refine.settings import COARSE
from lgrasp.object.model import ObjectModel
from lgrasp.object.params import ObjectParams
from lgrasp.planning.planner import Planner, PlanParams, cloud_params
from lgrasp.planning.starts import STAND_OFF
from lgrasp.refine.refiner import Pose, Refiner, table_pose
from lgrasp.refine.surface import hand_surface
from lgrasp.refine.visible_surface import seen_palmar
from lgrasp.runtime.device import resolve_device
from lgrasp.simulate.protocol import find_protocol
from lgrasp.simulate.run import verdicts
from lgrasp.simulate.scene import Scene, scene_of

NOISES = (0.0, 0.002, 0.005, 0.01)
"""Standard deviations of the points of clouds, besides meshes [m]."""
STEPS = (0, 3, 6, 10, 13)
"""Outer steps after which the energy is measured."""

PUBLISHED = {
    "barrett": {
        "epsilon": 0.201,
        "valid": (0.6766, 0.6432, 0.5598, 0.3745),
        "seconds": (0.030, 0.032, 0.036, 0.054),
        "energy": (863.61, 148.44, 90.08, 67.43, 60.32),
    },
    "schunk_svh": {
        "epsilon": 0.170,
        "valid": (0.2650, 0.2511, 0.2121, 0.1470),
        "seconds": (0.118, 0.125, 0.147, 0.213),
        "energy": (3323.51, 669.42, 381.05, 266.21, 227.39),
    },
}
"""Figures of the paper on an RTX 3080 by hand: epsilon; valid shares and seconds per valid grasp by NOISES; energy by
STEPS, in 1e-5 of its unit."""

_POINTS = 6000
_SHIFT, _TURN, _BEND = (
    0.01,
    0.15,
    0.15,
)  # standard deviations of a coarse pose: [m] an axis, [rad] an axis, [rad] a joint


class Planning(NamedTuple):
    """Plans of one hand over some objects."""

    starts: int
    planned: int
    valid: int  # of these that hold their object in simulation
    epsilon: float  # mean of the valid ones
    seconds: float  # of the planning

    @property
    def share(self) -> float:
        return self.valid / max(self.starts, 1)

    @property
    def seconds_each(self) -> float:
        """Per valid grasp."""
        return self.seconds / max(self.valid, 1)


class HandBench(NamedTuple):
    """What was measured of a hand."""

    hand: str
    mesh: Planning
    clouds: dict[float, Planning]
    """By noise [m]."""
    energy: tuple[float, ...]
    """Mean E* of coarse poses after STEPS rounds of matching."""
    milliseconds: tuple[float, ...]
    """Time of one pose there, all poses side by side."""
    poses: int


@dataclass(frozen=True)
class _Case:
    """One object."""

    model: ObjectModel
    scene: Scene


@dataclass
class _Total:
    starts: int = 0
    planned: int = 0
    seconds: float = 0.0
    epsilon: list[np.ndarray] = field(default_factory=list)

    def result(self) -> Planning:
        epsilon = np.concatenate([np.zeros(0), *self.epsilon])
        mean = float(epsilon.mean()) if len(epsilon) else 0.0
        return Planning(self.starts, self.planned, len(epsilon), mean, self.seconds)


def bench_hand(
    hand: str,
    objects: Sequence[str],
    starts: int,
    *,
    protocol: str = "fc",
    noises: Sequence[float] = NOISES,
    device: str = "auto",
    cache: Cache | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> HandBench:
    """Plan and refine with one hand.

    Tables I and IV: ``starts`` on each object, once on its mesh and once for each noise on points of its surface with
    the normals of the clean surface; a plan is valid when it holds the true object under the physics protocol.
    Table III: the valid plans on meshes, displaced as a network would be (1 cm and 0.15 rad an axis, 0.15 rad a joint),
    refined by ``COARSE``.

    Raises:
        LgraspError: hand, object, device or protocol are unknown.
    """
    cache, at = cache or Cache(), resolve_device(device)
    source, model = named_hand(cache, hand, at)
    arrays, palmar = upload_hand(model, at.alias), seen_palmar(source, model, at.alias)
    record = hand_record(model, mesh_blobs(source.urdf))
    judge = partial(_holds, find_protocol(protocol).name)
    cases = []
    for name in objects:
        mesh, key = object_key(name, 1.0, ObjectParams())
        obj, _ = load_object(cache, mesh, key, 1.0, ObjectParams(), at.alias)
        cut = partial(decompose, store=cache)
        cases.append(_Case(obj, scene_of(record, [object_record(obj)], cut, at.alias)))
    stand_off = source.spec.stand_off or STAND_OFF
    totals: dict[float | None, _Total] = {None: _Total(), **{noise: _Total() for noise in noises}}
    coarse: list[tuple[ObjectModel, Pose]] = []
    for case in cases:
        for noise, total in totals.items():
            target = case.model if noise is None else _cloud(case.model, noise)
            what = "mesh" if noise is None else f"cloud, {1e3 * noise:g} mm"
            params = PlanParams() if noise is None else cloud_params(PlanParams())
            planner = Planner(arrays, target, stand_off, params, palmar)
            if not any(t.starts for t in totals.values()):
                planner.run(1)  # kernels are compiled outside of the clock
            begin = time.perf_counter()
            grasps, counts = planner.run(starts)
            seconds = time.perf_counter() - begin
            holds = judge(case.scene, shard_rows(grasps, model, target)) if len(grasps) else np.zeros(0, bool)
            progress(f"{hand}, {case.model.name}, {what}: {int(holds.sum())} of {starts}, {seconds:.1f} s")
            total.starts += counts["starts"]
            total.planned += len(grasps)
            total.seconds += seconds
            total.epsilon.append(grasps.metrics["epsilon"][holds])
            if noise is None:
                coarse.append((case.model, _displaced(grasps, holds, at.alias)))
    energy, milliseconds, poses = _falls(arrays.model, palmar, coarse, at.alias)
    clouds = {noise: total.result() for noise, total in totals.items() if noise is not None}
    return HandBench(hand, totals[None].result(), clouds, energy, milliseconds, poses)


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


def _falls(hand, palmar, coarse: list[tuple[ObjectModel, Pose]], device: str):
    """Mean energy of coarse poses, and the milliseconds of one, after STEPS rounds of matching; and their number."""
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
    return tuple((energy / each).tolist()), tuple((1e3 * seconds / each).tolist()), count
