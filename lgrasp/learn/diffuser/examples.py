"""What the network is trained on: steps of sequences as rows, and the objects as it sees them."""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from lgrasp.geometry.rotations import sixd_from_matrix
from lgrasp.hand.model import HandModel
from lgrasp.hand.tree import Tree
from lgrasp.learn.diffuser.features import (
    HELD_MARGIN,
    SHAPE_RADIUS,
    ball_points,
    box_points,
    held_features,
    random_rotations,
    shape_features,
)
from lgrasp.learn.diffuser.network import POSE, DiffuserNet, Situation, spread_of
from lgrasp.learn.diffuser.params import DiffuserParams
from lgrasp.learn.diffuser.senses import HeldObjects, Senses, sense_points
from lgrasp.object.sdf import SdfGrid


class SequenceSteps(NamedTuple):
    """E steps of sequences of one hand with K joints; objects are numbered over all shards."""

    R: torch.Tensor
    """Rotation of the object that is grasped in the hand frame, centred frame of the object, (E, 3, 3)."""
    t: torch.Tensor
    """Its position [m], (E, 3)."""
    q: torch.Tensor
    """Joints after the step [rad or m], (E, K)."""
    start: torch.Tensor
    """Joints before, (E, K)."""
    used: torch.Tensor
    """Joints that hold something before, (E, K) bool."""
    free: torch.Tensor
    """Joints that the step may move, (E, K) bool."""
    space: torch.Tensor
    """Opposition space, (E,) int64."""
    object: torch.Tensor
    """What is grasped, (E,) int64."""
    held: torch.Tensor
    """What is held before, (E, S) int64, -1 none."""
    held_rotation: torch.Tensor
    """(E, S, 3, 3)."""
    held_position: torch.Tensor
    """(E, S, 3) [m]."""

    def rows(self, index: torch.Tensor) -> "SequenceSteps":
        """Some of the steps, by index or mask."""
        return SequenceSteps(*(x[index] for x in self))


def unseen_objects(meshes: Sequence[str], share: float, seed: int) -> torch.Tensor:
    """Which objects are held out, (O,) bool: those of a share of the different meshes, in all their sizes."""
    different = sorted(set(meshes))
    order = torch.randperm(len(different), generator=torch.Generator().manual_seed(seed)).tolist()
    out = {different[i] for i in order[: round(share * len(different))]}
    return torch.tensor([mesh in out for mesh in meshes])


def split_steps(grasped: torch.Tensor, held: torch.Tensor, unseen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Indices of the steps that no unseen object has to do with, and of those that grasp one; those that only hold one
    are neither.

    Args:
        grasped: (E,); held: (E, S), -1 none; unseen: (O,) bool.
    """
    holds = (unseen[held] & (held >= 0)).any(1)
    return (~holds & ~unseen[grasped]).nonzero()[:, 0], unseen[grasped].nonzero()[:, 0]


def make_net(hand: HandModel, spaces: int, params: DiffuserParams) -> DiffuserNet:
    """A network with random weights for a hand with some opposition spaces."""
    tree = hand.tree
    lower, upper = (torch.as_tensor(x, dtype=torch.float32) for x in (tree.joint_lower, tree.joint_upper))
    state = torch.random.get_rng_state()
    torch.manual_seed(params.seed)
    basis = ball_points(params.shape_points, SHAPE_RADIUS, params.seed)
    low, high = hand.canonical_box
    held = box_points(params.held_points, low - HELD_MARGIN, high + HELD_MARGIN, params.seed)
    net = DiffuserNet(lower, upper, spaces, basis, held, sense_points(hand, params.sense_points), params)
    torch.random.set_rng_state(state)
    return net


class Sights(NamedTuple):
    """How objects are seen: O objects, V frames of each one after another."""

    R: torch.Tensor
    """Axes of a frame in that of the object as columns, (O V, 3, 3)."""
    t: torch.Tensor
    """Its origin there [m], (O V, 3)."""


class StepExamples:
    """Steps as the network is given them, all on one device.

    Each object is seen in ``turns`` rotations, its frame turned alike, so that nothing is learnt about frames.

    Args:
        clouds: of all objects, centred, (O, n, 3) [m]. grids: their distances.
        sights: where clouds and grids are those of ``each`` views of every object, in frames of their own; one is drawn
            for each example.
    """

    def __init__(
        self,
        tree: Tree,
        steps: SequenceSteps,
        clouds: torch.Tensor,
        grids: Sequence[SdfGrid],
        net: DiffuserNet,
        params: DiffuserParams,
        device: str | torch.device = "cpu",
        sights: Sights | None = None,
        each: int = 1,
    ) -> None:
        steps, clouds = SequenceSteps(*(x.to(device) for x in steps)), clouds.to(device)
        draw = torch.Generator().manual_seed(params.seed)
        self.turns = random_rotations(params.turns, draw).to(device)
        basis, held_basis = net.basis.to(device), net.held_basis.to(device)
        self.shapes = torch.stack([shape_features(basis, cloud, self.turns).half() for cloud in clouds])  # (O, V, B)
        self.held = held_features(held_basis, clouds, steps.held, steps.held_rotation, steps.held_position).half()
        self.steps = steps
        self.sights = None if sights is None else Sights(*(x.to(device) for x in sights))
        self.each = each
        self.senses = Senses(tree, net.senses, net.held_basis, grids, device)

    def __len__(self) -> int:
        return len(self.steps.t)

    @property
    def ways(self) -> int:
        """In how many ways an object is seen: views times rotations."""
        return self.each * len(self.turns)

    def statistics(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and spread of rows, (9 + K,) each; of rotations those of all rotations."""
        s, n = self.steps, len(self)
        way = torch.randint(self.ways, (n,), generator=torch.Generator().manual_seed(0)).to(s.t.device)
        R, t, q = self._goals(torch.arange(n, device=s.t.device), way)
        there = torch.cat([torch.ones(n, POSE, dtype=torch.bool, device=s.t.device), s.free], 1)
        mean, spread = spread_of(torch.cat([t, sixd_from_matrix(R), q], 1), there)
        mean[3:POSE], spread[3:POSE] = 0.0, 3**-0.5
        return mean, spread

    def batch(self, rows: torch.Tensor, way: torch.Tensor) -> tuple[tuple[torch.Tensor, ...], Situation]:
        """R, t and q of steps, (n, ...), and their situations, with objects seen in ways (n,)."""
        s = self.steps
        number, turn = self._seen(rows, way)
        situation = Situation(
            self.shapes[number, turn],
            self.held[rows],
            s.start[rows],
            s.used[rows],
            s.free[rows],
            s.space[rows],
        )
        return self._goals(rows, way), situation

    def held_objects(self, rows: torch.Tensor) -> HeldObjects:
        """What the hands of steps hold before."""
        s = self.steps
        return HeldObjects(s.held[rows], s.held_rotation[rows], s.held_position[rows])

    def felt(self, rows: torch.Tensor, way: torch.Tensor, step: tuple[torch.Tensor, ...]) -> torch.Tensor:
        """What the hands of steps feel in other poses and postures, R, t and q, with objects seen in ways (n,)."""
        R, t, q = step
        number, turn = self._seen(rows, way)
        return self.senses(R @ self.turns[turn], t, q, number, self.held_objects(rows))

    def _goals(self, rows: torch.Tensor, way: torch.Tensor) -> tuple[torch.Tensor, ...]:
        s = self.steps
        R, t, q = s.R[rows], s.t[rows], s.q[rows]
        number, turn = self._seen(rows, way)
        if self.sights:
            R, t = R @ self.sights.R[number], t + (R @ self.sights.t[number, :, None])[..., 0]
        return R @ self.turns[turn].mT, t, q

    def _seen(self, rows: torch.Tensor, way: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Numbers of the cloud and the rotation."""
        return self.steps.object[rows] * self.each + way // len(self.turns), way % len(self.turns)
