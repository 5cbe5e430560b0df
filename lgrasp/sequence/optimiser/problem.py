"""A batch of rows to optimise: coordinates, contact points of their opposition spaces, energies with gradients."""

from collections.abc import Sequence

import numpy as np
import torch

from lgrasp.geometry.rotations import matrix_from_sixd, sixd_from_matrix, so3_exp
from lgrasp.hand.model import HandModel
from lgrasp.hand.opposition.spaces import Space
from lgrasp.sequence.optimiser.energy import GraspEnergy, HandContacts


class Sides:
    """Contact points of the two sides of each of S opposition spaces.

    Args:
        hand: with a contact surface for each space, whose contact points the indices mean. spaces: the same spaces.
    """

    def __init__(
        self,
        hand: HandModel,
        spaces: Sequence[Space],
        *,
        device: str | torch.device = "cpu",
    ) -> None:
        ranges = []
        for number, space in enumerate(spaces):
            runs = [hand.contact_run(number, g) for g in space.groups]
            ranges.append([hand.contact_first[run : run + 2] for run in runs])
        first, end = np.moveaxis(np.array(ranges), 2, 0)  # each (S, 2)
        self._first = torch.as_tensor(first, dtype=torch.int64, device=device)
        self._count = torch.as_tensor(end - first, dtype=torch.int64, device=device)
        self._point = torch.as_tensor(hand.contact_points, dtype=torch.float32, device=device)
        self._normal = torch.as_tensor(hand.contact_normals, dtype=torch.float32, device=device)
        self._body = torch.as_tensor(hand.contact_body, dtype=torch.int64, device=device)

    def counts(self, space: torch.Tensor) -> torch.Tensor:
        """Points on the sides of spaces (N,): (N, 2)."""
        return self._count[space]

    def index(self, space: torch.Tensor, chosen: torch.Tensor) -> torch.Tensor:
        """Index in the hand's contact points, (N, 2), of points of sides, numbered from 0, (N, 2)."""
        return self._first[space] + chosen

    def contacts(self, space: torch.Tensor, chosen: torch.Tensor) -> HandContacts:
        """Bodies and places of points of sides."""
        at = self.index(space, chosen)
        return HandContacts(self._body[at], self._point[at])

    def points(self, space: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """All points of the sides of spaces (N,), (N, 2, P), and which of them are there: sides differ in size."""
        number = torch.arange(int(self._count.max()), device=space.device)
        listed = number < self._count[space][..., None]
        return self._first[space][..., None] + torch.where(listed, number, 0), listed

    def placed(
        self, points: torch.Tensor, bodies: tuple[torch.Tensor, torch.Tensor]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Places [m] and outward normals, base frame, (N, 2, P, 3), of points that :meth:`points` lists.

        Args:
            bodies: R (N, B, 3, 3) and t (N, B, 3) of the hand's bodies.
        """
        body = self._body[points]
        row = torch.arange(len(points), device=points.device)[:, None, None]
        R, t = bodies[0][row, body], bodies[1][row, body]
        place = (R * self._point[points][..., None, :]).sum(-1) + t
        return place, (R * self._normal[points][..., None, :]).sum(-1)


class GraspProblem:
    """N rows; coordinates x (N, 9 + K): the object's position [m], its rotation in 6D, joints [rad or m].

    Args:
        space: (N,) opposition space of each row.
        held: poses of the objects held, R (N, n - 1, 3, 3) and t (N, n - 1, 3).
    """

    def __init__(
        self, energy: GraspEnergy, sides: Sides, space: torch.Tensor, held: tuple[torch.Tensor, torch.Tensor]
    ) -> None:
        self.energy, self.sides, self.space, self.held = energy, sides, space, held

    def by_coordinates(
        self, x: torch.Tensor, contact: torch.Tensor, weights: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Energies (N, 6), and the gradient of their weighted sum by x, (N, 9 + K)."""
        x = x.detach().requires_grad_()
        R, t, q = matrix_from_sixd(x[:, 3:9]), x[:, :3], x[:, 9:]
        return self._gradient(R, t, q, contact, weights, x)

    def by_motion(
        self, x: torch.Tensor, contact: torch.Tensor, weights: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Energies (N, 6), and the gradient of their weighted sum by a motion from x (:meth:`moved`), (N, 6 + K)."""
        motion = torch.zeros(len(x), x.shape[1] - 3, dtype=x.dtype, device=x.device, requires_grad=True)
        R = matrix_from_sixd(x[:, 3:9]) @ so3_exp(motion[:, 3:6])
        return self._gradient(R, x[:, :3] + motion[:, :3], x[:, 9:] + motion[:, 6:], contact, weights, motion)

    def _gradient(
        self,
        R: torch.Tensor,
        t: torch.Tensor,
        q: torch.Tensor,
        contact: torch.Tensor,
        weights: torch.Tensor,
        by: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        terms = self.energy(R, t, q, self.sides.contacts(self.space, contact), self.held)
        (gradient,) = torch.autograd.grad((terms * weights).sum(), by)
        return terms.detach(), gradient

    @staticmethod
    def moved(x: torch.Tensor, motion: torch.Tensor) -> torch.Tensor:
        """Coordinates after motions (N, 6 + K): a shift [m], a turn about the object's axes [rad], joint changes."""
        R = matrix_from_sixd(x[:, 3:9]) @ so3_exp(motion[:, 3:6])
        return torch.cat([x[:, :3] + motion[:, :3], sixd_from_matrix(R), x[:, 9:] + motion[:, 6:]], 1)

    @staticmethod
    def retract(x: torch.Tensor) -> torch.Tensor:
        """Coordinates with the two columns of the rotation made orthonormal."""
        return torch.cat([x[:, :3], sixd_from_matrix(matrix_from_sixd(x[:, 3:9])), x[:, 9:]], 1)
