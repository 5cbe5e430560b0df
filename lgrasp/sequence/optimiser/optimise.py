"""Grasps of one more object by minimising the energy from random starts: methods ``anneal`` and ``mala``."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from lgrasp.geometry.rotations import matrix_from_sixd, motion_from_pose, pose_from_motion, sixd_from_matrix
from lgrasp.grasp.predicted import TouchingGrasps
from lgrasp.hand.model import HandModel
from lgrasp.hand.opposition.spaces import Space
from lgrasp.object.model import ObjectModel
from lgrasp.runtime.streams import uniforms
from lgrasp.sequence.optimiser.anneal import Annealing, Langevin, Proposals, run_chain, step_lengths, temperatures
from lgrasp.sequence.optimiser.contacts import touching_points
from lgrasp.sequence.optimiser.energy import TERMS, GraspEnergy
from lgrasp.sequence.optimiser.params import OptimiserParams
from lgrasp.sequence.optimiser.problem import GraspProblem, Sides
from lgrasp.sequence.optimiser.start import start_poses

_CPU_ROWS, _GPU_ROWS = 256, 512  # worked on at once; fewer leave a GPU half idle


@dataclass(frozen=True)
class Optimised(TouchingGrasps):
    """Grasps of H rows, whether good or not."""

    energies: np.ndarray
    """In the order of TERMS, with these contact points, without weights, (H, 6)."""


def optimise(
    hand: HandModel,
    spaces: Sequence[Space],
    objects: Sequence[ObjectModel],
    *,
    space: np.ndarray,
    q: np.ndarray,
    free: np.ndarray,
    held: np.ndarray,
    seed: np.ndarray,
    params: OptimiserParams,
    method: Literal["anneal", "mala"] = "anneal",
    device: str = "cpu",
    rows: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Optimised:
    """Grasp the last object in H rows that hold the objects before it.

    A row's result is a function of its own inputs, on one type of device.

    Args:
        hand: with a contact surface for each of the spaces.
        objects: n of them, the new one last.
        space: opposition space of each row, index in ``spaces``, (H,).
        q: posture to start from, (H, K) [rad or m]. free: joints that may move, (H, K) bool.
        held: poses of the objects held, internal frames, device poses (H, n - 1, 7).
        seed: of each row, (H,) integers.
        rows: how many are worked on at once; no result on a CPU depends on it.
        progress: called with steps done and steps in all.
    """
    energy = GraspEnergy(
        hand,
        objects,
        hand_points=params.hand_points,
        object_points=params.object_points,
        point_unit=params.point_unit,
        device=device,
    )
    sides = Sides(hand, spaces, device=device)
    rows = rows or (_CPU_ROWS if device == "cpu" else _GPU_ROWS)
    blocks = [np.arange(first, min(first + rows, len(q))) for first in range(0, len(q), rows)]
    parts = []
    for number, block in enumerate(blocks):
        # on a GPU sums depend on the number of rows, so it is always the same there
        filled = block if device == "cpu" else np.resize(block, rows)

        def put(values: np.ndarray, dtype: torch.dtype, filled: np.ndarray = filled) -> torch.Tensor:
            return torch.as_tensor(values[filled], dtype=dtype, device=device)

        at = motion_from_pose(put(held, torch.float32))
        problem = GraspProblem(energy, sides, put(space, torch.int64), at)

        def report(step: int, before: int = number * params.iterations) -> None:
            if progress is not None:
                progress(before + step, len(blocks) * params.iterations)

        columns = _optimise_block(
            hand,
            objects,
            problem,
            put(q, torch.float32),
            put(free, torch.bool),
            put(seed.astype(np.int64), torch.int64),
            params,
            method,
            report,
        )
        parts.append([column[: len(block)].cpu().numpy() for column in columns])
    pose, joints, hand_point, object_point, energies = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Optimised(pose, np.where(free, joints, q).astype(np.float32), hand_point, object_point, energies)


def _optimise_block(
    hand: HandModel,
    objects: Sequence[ObjectModel],
    problem: GraspProblem,
    q: torch.Tensor,
    free: torch.Tensor,
    seed: torch.Tensor,
    params: OptimiserParams,
    method: str,
    progress: Callable[[int], None],
) -> list[torch.Tensor]:
    """Columns of :class:`Optimised`."""
    R, t = start_poses(hand, objects, problem.held, uniforms(seed, params.iterations + 1, 7))
    chain = run_chain(
        _proposals(problem, free, seed, params, method),
        torch.cat([t.to(q.dtype), sixd_from_matrix(R).to(q.dtype), q], 1),
        problem.sides.counts(problem.space),
        seed,
        torch.as_tensor(_weights(params), dtype=q.dtype, device=q.device),
        switch=params.switch,
        culling=problem.energy.culling,
        progress=progress,
    )
    q = torch.where(free, chain.x[:, 9:].clamp(problem.energy.lower, problem.energy.upper), q)
    R, t = matrix_from_sixd(chain.x[:, 3:9]), chain.x[:, :3]
    chosen = touching_points(problem, torch.cat([chain.x[:, :9], q], 1))
    contacts = problem.sides.contacts(problem.space, chosen)
    terms = problem.energy(R, t, q, contacts, problem.held)
    at = problem.energy.contact_points(R, t, problem.energy.kinematics(q), contacts)
    surface = torch.as_tensor(objects[-1].contact_points, device=q.device)
    nearest = torch.cdist(at.reshape(-1, 3), surface).argmin(1).reshape(-1, 2)
    index = problem.sides.index(problem.space, chosen)
    return [pose_from_motion(R, t), q, index, nearest, terms]


def _weights(params: OptimiserParams) -> np.ndarray:
    """Weights of the energies in each step, (S, 6)."""
    growth = np.linspace(0, 1, params.iterations)
    first, last = params.w_hop
    hop = first ** (1 - growth) * last**growth
    others = {"fc": params.w_fc, "dis": params.w_dis, "hsp": params.w_hsp, "joint": params.w_joint, "oop": params.w_oop}
    return np.column_stack([hop if name == "hop" else np.full_like(hop, others[name]) for name in TERMS])


def _proposals(
    problem: GraspProblem, free: torch.Tensor, seed: torch.Tensor, params: OptimiserParams, method: str
) -> Proposals:
    def with_pose(joints: torch.Tensor, width: int) -> torch.Tensor:
        return torch.cat([torch.ones(len(joints), width, dtype=joints.dtype, device=joints.device), joints], 1)

    if method == "anneal":
        return Annealing(problem.by_coordinates, problem.retract, with_pose(free, 9), params)
    # noise as long as the published step; angles are turned by more
    length = with_pose(free.to(problem.energy.lower.dtype) * params.mala_turn, 6)
    length[:, 3:6] *= params.mala_turn
    lengths = step_lengths(params, seed.device)
    warmth = temperatures(params, seed.device) * (params.mala_temperature / params.temperature)

    def scale(step: torch.Tensor) -> torch.Tensor:
        return (lengths.take(step) * length) ** 2 / (2 * warmth.take(step))

    return Langevin(problem.by_motion, problem.moved, seed, scale, warmth.take)
