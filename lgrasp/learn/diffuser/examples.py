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


class StepExamples:
    """Steps as the network is given them, all on one device.

    Each object is seen in ``turns`` rotations, its frame turned alike, so that nothing is learnt about frames.

    Args:
        clouds: of all objects, centred, (O, n, 3) [m]. grids: their distances.
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
    ) -> None:
        steps, clouds = SequenceSteps(*(x.to(device) for x in steps)), clouds.to(device)
        draw = torch.Generator().manual_seed(params.seed)
        self.turns = random_rotations(params.turns, draw).to(device)
        basis, held_basis = net.basis.to(device), net.held_basis.to(device)
        self.shapes = torch.stack([shape_features(basis, cloud, self.turns).half() for cloud in clouds])  # (O, V, B)
        self.held = held_features(held_basis, clouds, steps.held, steps.held_rotation, steps.held_position).half()
        self.steps = steps
        self.senses = Senses(tree, net.senses, net.held_basis, grids, device)

    def __len__(self) -> int:
        return len(self.steps.t)

    def statistics(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and spread of rows, (9 + K,) each; of rotations those of all rotations."""
        s = self.steps
        there = torch.cat([torch.ones(len(self), POSE, dtype=torch.bool, device=s.t.device), s.free], 1)
        mean, spread = spread_of(torch.cat([s.t, sixd_from_matrix(s.R), s.q], 1), there)
        mean[3:POSE], spread[3:POSE] = 0.0, 3**-0.5
        return mean, spread

    def batch(self, rows: torch.Tensor, turn: torch.Tensor) -> tuple[tuple[torch.Tensor, ...], Situation]:
        """R, t and q of steps, (n, ...), and their situations, with objects in the frames of turns (n,)."""
        s = self.steps
        situation = Situation(
            self.shapes[s.object[rows], turn],
            self.held[rows],
            s.start[rows],
            s.used[rows],
            s.free[rows],
            s.space[rows],
        )
        return (s.R[rows] @ self.turns[turn].mT, s.t[rows], s.q[rows]), situation

    def held_objects(self, rows: torch.Tensor) -> HeldObjects:
        """What the hands of steps hold before."""
        s = self.steps
        return HeldObjects(s.held[rows], s.held_rotation[rows], s.held_position[rows])

    def felt(self, rows: torch.Tensor, turn: torch.Tensor, step: tuple[torch.Tensor, ...]) -> torch.Tensor:
        """What the hands of steps feel in other poses and postures, R, t and q, with objects in turned frames."""
        R, t, q = step
        return self.senses(R @ self.turns[turn], t, q, self.steps.object[rows], self.held_objects(rows))
