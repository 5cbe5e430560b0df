"""Grasps of one more object by minimising the energy from random starts, in which the hand faces a random point of the
object's hull: methods ``anneal`` and ``mala``."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import trimesh

from lgrasp.geometry.clusters import CLUSTER_SIZE
from lgrasp.geometry.rotations import matrix_from_sixd, motion_from_pose, pose_from_motion, sixd_from_matrix
from lgrasp.grasp.predicted import TouchingGrasps
from lgrasp.hand.model import HandModel
from lgrasp.hand.opposition.spaces import Space
from lgrasp.object.model import ObjectModel
from lgrasp.runtime.streams import uniforms
from lgrasp.sequence.optimiser.anneal import Annealing, Langevin, Proposals, run_chain, step_lengths, temperatures
from lgrasp.sequence.optimiser.energy import TERMS, GraspEnergy
from lgrasp.sequence.optimiser.params import OptimiserParams
from lgrasp.sequence.optimiser.problem import GraspProblem, Sides

_CPU_ROWS, _GPU_ROWS = 256, 512  # worked on at once; fewer leave a GPU half idle
_GAP_SCALE = 0.002  # [m]
_ANGLE_SCALE = 1 - math.cos(math.radians(20))
_BALANCE_SCALE = 0.1
"""A gap [m], 1 - cosine of the angle of the normals, and an energy fc that count alike."""
_POINTS_EXAMINED, _POINTS_PAIRED = 32, 12  # points of a side whose normals are looked at, and those that are paired


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
    for block in blocks:
        # on a GPU sums depend on the number of rows, so it is always the same there
        filled = block if device == "cpu" else np.resize(block, rows)

        def put(values: np.ndarray, dtype: torch.dtype, filled: np.ndarray = filled) -> torch.Tensor:
            return torch.as_tensor(values[filled], dtype=dtype, device=device)

        at = motion_from_pose(put(held, torch.float32))
        problem = GraspProblem(energy, sides, put(space, torch.int64), at)

        columns = _optimise_block(
            hand,
            objects,
            problem,
            put(q, torch.float32),
            put(free, torch.bool),
            put(seed.astype(np.int64), torch.int64),
            params,
            method,
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
    hop = first + (last - first) * growth if params.w_hop_growth == "linear" else first ** (1 - growth) * last**growth
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


@torch.no_grad()
def touching_points(problem: GraspProblem, x: torch.Tensor) -> torch.Tensor:
    """The pair of points, one of each side and numbered from 0 there, that touches and balances best, (N, 2) int64.

    The energies take single points out of each side at random; a finished grasp touches with whatever is nearest.

    Args:
        x: (N, 9 + K) coordinates of a :class:`GraspProblem`.
    """
    points, listed = problem.sides.points(problem.space)  # (N, 2, P)
    R, t = matrix_from_sixd(x[:, 3:9]), x[:, :3]
    bodies = problem.energy.kinematics(x[:, 9:])
    at, _ = problem.sides.placed(points, bodies)
    local = _back(R, at - t[:, None, None])
    gap = torch.where(listed, problem.energy.distance(local).abs(), torch.inf)
    gap, near = gap.topk(min(_POINTS_EXAMINED, gap.shape[2]), largest=False)
    points = points.gather(2, near)
    local, normal = torch.take_along_dim(local, near[..., None], 2), _back(R, problem.sides.placed(points, bodies)[1])
    outward = problem.energy.normals(local)
    badness = gap / _GAP_SCALE + (1 + (normal * outward).sum(-1)) / _ANGLE_SCALE
    badness, best = badness.topk(min(_POINTS_PAIRED, gap.shape[2]), largest=False)  # (N, 2, B)
    chosen = [torch.take_along_dim(v, best[..., None], 2) for v in (local, outward)]
    pair = [v[:, side] for v in chosen for side in (0, 1)]  # each (N, B, 3): places of both sides, normals of both
    first, second = (v.shape[1] for v in pair[:2])
    x2 = torch.stack([pair[0][:, :, None].expand(-1, -1, second, 3), pair[1][:, None].expand(-1, first, -1, 3)], 3)
    n2 = torch.stack([pair[2][:, :, None].expand(-1, -1, second, 3), pair[3][:, None].expand(-1, first, -1, 3)], 3)
    fc = problem.energy.balance(x2.reshape(-1, 2, 3), n2.reshape(-1, 2, 3)).reshape(len(x), first, second)
    total = badness[:, 0, :, None] + badness[:, 1, None] + fc / _BALANCE_SCALE
    flat = total.flatten(1).argmin(1)
    rank = torch.stack([flat // second, flat % second], 1)[..., None]
    return near.gather(2, best.gather(2, rank))[..., 0]


def _back(R: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """R^T v of vectors (N, 2, P, 3)."""
    return (R[:, None, None] * v[..., :, None]).sum(-2)


def start_poses(
    hand: HandModel, objects: Sequence[ObjectModel], held: tuple[torch.Tensor, torch.Tensor], u: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Poses R (N, 3, 3) and t (N, 3) [m] of the last object, f64: a hull point in front of the hand, any roll.

    A point of the object's convex hull, uniform by area, comes to a point of the hand's canonical box, with the hull's
    normal towards the palm; and as far out along that line as clears the balls around the objects held.

    Args:
        held: poses of the objects before, R (N, n - 1, 3, 3) and t (N, n - 1, 3).
        u: uniform numbers, (N, 7) f64.
    """
    new = objects[-1]
    hull = trimesh.convex.convex_hull(new.vertices.astype(float) - new.center)
    axis, low, high = _front(hand)
    corners = torch.tensor(hull.triangles).to(u)
    share = torch.from_numpy(hull.area_faces.cumsum() / hull.area_faces.sum()).to(u)
    face = torch.searchsorted(share, u[:, 0].contiguous()).clamp_max(len(corners) - 1)
    a, b, c = corners[face].unbind(1)
    r = u[:, 1:2].sqrt()
    point = (1 - r) * a + r * (1 - u[:, 2:3]) * b + r * u[:, 2:3] * c
    normal = torch.tensor(hull.face_normals).to(u)[face]
    forward = torch.from_numpy(axis).to(u)
    roll = 2 * torch.pi * u[:, 3:4]
    # frames with the given third axis; the second one is rolled
    A, B = _frame(-forward.expand_as(normal)), _frame(normal)
    x, y = A[..., 0] * roll.cos() + A[..., 1] * roll.sin(), A[..., 1] * roll.cos() - A[..., 0] * roll.sin()
    R = torch.stack([x, y, A[..., 2]], -1) @ B.transpose(1, 2)
    at = torch.from_numpy(low).to(u) + u[:, 4:] * torch.from_numpy(high - low).to(u)
    if len(objects) > 1:
        radius = torch.tensor([float(np.linalg.norm(o.obstacle_points, axis=1).max()) for o in objects[:-1]]).to(u)
        beyond = ((held[1].to(u) - at[:, None]) @ forward + radius).amax(1)
        at = at + beyond.clamp_min(0)[:, None] * forward
    return R, at - (R @ point[..., None])[..., 0]


def _front(hand: HandModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The direction in which the palm faces, and the corners of the canonical box."""
    low, high = hand.canonical_box.astype(float)
    base = hand.samples[: hand.cluster_first[1] * CLUSTER_SIZE]
    centre = 0.5 * (low + high)
    nearest = base[np.linalg.norm(base - centre, axis=1).argmin()] if len(base) else np.zeros(3)
    return (centre - nearest) / max(float(np.linalg.norm(centre - nearest)), 1e-9), low, high


def _frame(z: torch.Tensor) -> torch.Tensor:
    """Rotations (N, 3, 3) whose third column is z (N, 3)."""
    smallest = z.abs().argmin(1, keepdim=True)
    x = torch.linalg.cross(z, torch.zeros_like(z).scatter(1, smallest, 1.0))
    x = x / x.norm(dim=1, keepdim=True)
    return torch.stack([x, torch.linalg.cross(z, x), z], -1)
