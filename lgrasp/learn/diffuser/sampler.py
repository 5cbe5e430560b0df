"""Steps drawn by a trained network for hands that hold objects already."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import NamedTuple, TypeVar

import numpy as np
import torch

from lgrasp.geometry.rotations import motion_from_pose, pose_from_motion
from lgrasp.grasp.sequences import HeldHands
from lgrasp.hand.tree import Tree
from lgrasp.learn.diffuser.features import held_features, random_rotations, shape_features
from lgrasp.learn.diffuser.network import DiffuserNet, Situation, joints_of
from lgrasp.learn.diffuser.process import PROCESSES, Process
from lgrasp.learn.diffuser.senses import HeldObjects, Senses
from lgrasp.object.sdf import SdfGrid
from lgrasp.runtime.streams import normals, uniforms

Result = TypeVar("Result")

_TURNS = 64  # rotations in which the network sees an object
_CPU_ROWS, _GPU_ROWS = 256, 32_768  # at a time


@contextmanager
def _short_products(device: torch.device) -> Iterator[None]:
    """Matrix products on a GPU round their factors to 11 bits, several times as fast."""
    before = torch.get_float32_matmul_precision()
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


class DrawnSteps(NamedTuple):
    """What was drawn, N of it."""

    pose: np.ndarray
    """T_hand_object of the next object's centred frame, device poses (N, 7) f32."""
    q: np.ndarray
    """Joints, those that may not move bit by bit as they are, (N, K) f32."""


@torch.no_grad()
def draw_steps(
    net: DiffuserNet,
    process: Process,
    senses: Senses,
    seen: Situation,
    noise: torch.Tensor,
    turn: torch.Tensor,
    grasped: torch.Tensor,
    held: HeldObjects,
    steps: int,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """R (N, 3, 3), t (N, 3) [m] and joints (N, K) of N steps.

    Args:
        seen: situations, with objects in turned frames. noise: (N, 9 + K). turn: of the frames, (N, 3, 3).
        grasped: number of the object to grasp, (N,) int64.
        steps: in which the noise is taken out.
    """
    moving, known = net.moving(seen.free), net.situation(seen)

    def velocity(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        R, position, q = net.noisy_steps(x, process.coefficients(t)[0], seen)
        return net(x, t, known, senses(R @ turn, position, q, grasped, held)) * moving

    R, t, q = net.steps(process.sample(velocity, noise * moving, steps))
    return R @ turn, t, joints_of(seen.start, q, seen.free)


def _in_threads(
    work: Callable[[torch.Tensor], Result], batches: Iterable[torch.Tensor], pool: Executor | None
) -> list[Result]:
    """Results of batches; in a pool of one thread each, which takes less time than several threads for one batch."""
    if pool is None:
        return [work(picked) for picked in batches]
    threads = torch.get_num_threads()

    def alone(picked: torch.Tensor) -> Result:
        torch.set_num_threads(1)
        return work(picked)

    try:
        return list(pool.map(alone, batches))
    finally:
        torch.set_num_threads(threads)


def _batches(count: int, device: torch.device) -> Iterator[torch.Tensor]:
    """Rows worked on at once. On a CPU always as many, the last one again and again: the size of what a library
    multiplies decides how it rounds."""
    if device.type != "cpu":
        yield from torch.arange(count).split(_GPU_ROWS)
        return
    for first in range(0, count, _CPU_ROWS):
        yield torch.arange(first, first + _CPU_ROWS).clamp_max(count - 1)


class StepSampler:
    """A network with the objects of a sequence before it.

    Args:
        process: name of the noising process that it was trained with.
        clouds: of the objects in their order, centred, (n, 3) [m] each. grids: their distances.
    """

    def __init__(
        self,
        tree: Tree,
        net: DiffuserNet,
        process: str,
        clouds: Sequence[np.ndarray],
        grids: Sequence[SdfGrid],
        device: str | torch.device = "cpu",
    ) -> None:
        self._device = torch.device(device)
        self._net = net.to(self._device).eval()
        self._process = PROCESSES[process]
        self._clouds = self._put(np.stack(clouds))
        self._turns = random_rotations(_TURNS, torch.Generator().manual_seed(0)).to(self._device)
        self._senses = Senses(tree, self._net.senses, self._net.held_basis, grids, self._device)
        self._shapes: dict[int, torch.Tensor] = {}  # by object: (V, B)

    @torch.no_grad()
    def draw(
        self,
        hands: HeldHands,
        space: np.ndarray,
        free: np.ndarray,
        *,
        each: int,
        seed: int,
        steps: int = 10,
        pool: Executor | None = None,
        view: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> DrawnSteps:
        """``each`` steps for each of H hands, those of one hand one after another: the object after those held.

        A function of its arguments; what is drawn for one hand does not depend on those after it, on a GPU but by
        rounding.

        Args:
            space: opposition spaces, (H,). free: joints that the steps may move, (H, K) bool.
            steps: of the sampling.
            pool: threads that work on batches on a CPU.
            view: axes (3, 3) and origin (3,) [m] of the object's frame in another one, of which the poses are then.
        """
        rows, joints = hands.q.shape
        number = hands.pose.shape[1]
        start, held = self._put(hands.q), self._held(hands, number)
        situation = Situation(
            self._shape(number)[:1].expand(rows, -1),
            held_features(self._net.held_basis, self._clouds, *held),
            start,
            self._put(hands.used, torch.bool),
            self._put(free, torch.bool),
            self._put(space, torch.int64),
        )
        count = rows * each

        def work(picked: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
            picked = picked.to(self._device)
            row, own_seed = picked // each, seed * each + picked
            own = (uniforms(own_seed, 1, 1)[:, 0] * _TURNS).long()
            seen = situation.rows(row)._replace(shape=self._shape(number)[own])
            objects = torch.full_like(row, number), HeldObjects(*(x[row] for x in held))
            given = normals(own_seed, 0, 9 + joints).float(), self._turns[own]
            with _short_products(self._device):
                return draw_steps(self._net, self._process, self._senses, seen, *given, *objects, steps)

        parts = _in_threads(work, _batches(count, self._device), pool if self._device.type == "cpu" else None)
        R, t, q = (torch.cat(x)[:count] for x in zip(*parts, strict=True))
        if view:
            view_R, view_t = map(self._put, view)
            R = R @ view_R.mT
            t = t - R @ view_t
        return DrawnSteps(pose_from_motion(R, t).cpu().numpy(), q.cpu().numpy())

    def warm(self, rows: int, each: int) -> None:
        """Draw as for ``rows`` hands, empty ones and those that hold something: a GPU loads what it runs when it first
        does, which takes longer than the draws."""
        if self._device.type == "cpu":
            return
        joints = len(self._net.lower)
        for number in range(min(2, len(self._clouds))):
            pose = np.tile(np.eye(7, dtype=np.float32)[6], (rows, number, 1))
            hands = HeldHands(np.zeros((rows, joints), np.float32), np.zeros((rows, joints), bool), pose)
            self.draw(hands, np.zeros(rows, int), ~hands.used, each=each, seed=0, steps=2)

    def _held(self, hands: HeldHands, number: int) -> HeldObjects:
        objects = torch.arange(number, device=self._device).expand(len(hands.q), number)
        return HeldObjects(objects, *motion_from_pose(self._put(hands.pose)))

    def _shape(self, number: int) -> torch.Tensor:
        """What the network sees of an object in each rotation, (V, B)."""
        if number not in self._shapes:
            self._shapes[number] = shape_features(self._net.basis, self._clouds[number], self._turns)
        return self._shapes[number]

    def _put(self, values: np.ndarray, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.tensor(values, dtype=dtype, device=self._device)
