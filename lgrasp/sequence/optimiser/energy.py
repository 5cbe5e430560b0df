"""The six energies of a grasp on one more object, for batches of rows, differentiable by object pose and joints."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from lgrasp.differentiable.distance import DistanceGrids, SurfaceNormals
from lgrasp.differentiable.kinematics import BodyKinematics
from lgrasp.differentiable.solids import hand_solids, object_solid
from lgrasp.hand.model import HandModel
from lgrasp.object.model import ObjectModel
from lgrasp.sequence.optimiser.penetration import PenetrationSums

TERMS = ("fc", "dis", "hop", "hsp", "joint", "oop")
"""Names of the energies, in order."""

_HAND_IN_OBJECT, _OBJECT_IN_HAND, _HAND_IN_HAND, _NEW_IN_HELD, _HELD_IN_NEW = range(5)


class HandContacts(NamedTuple):
    """One contact point on each of the two sides of a row's opposition space."""

    body: torch.Tensor  # (N, 2) int64 body that each rides on
    point: torch.Tensor  # (N, 2, 3) in its frame [m]


class GraspEnergy:
    """Energies of N rows that all hold the same n - 1 objects and grasp the same n-th one; frame: the hand's base.

    The hand is the same for all; postures, poses of held objects and contact points are by row.

    Args:
        objects: n of them, the one to grasp last.
        hand_points, object_points: surface points of the hand, and of each object.
        point_unit: depths are means over surface points, times this.
    """

    def __init__(
        self,
        hand: HandModel,
        objects: Sequence[ObjectModel],
        *,
        hand_points: int = 2048,
        object_points: int = 2048,
        point_unit: float = 2048,
        dtype: torch.dtype = torch.float32,
        device: str | torch.device = "cpu",
    ) -> None:
        put = partial(torch.as_tensor, dtype=dtype, device=device)
        links, new = hand_solids(hand, hand_points), objects[-1]
        self.kinematics = BodyKinematics(hand.tree, dtype=dtype, device=device)
        bodies, parts = len(hand.tree.joint_dof) + 1, len(links.solids)
        pairs = [(a, parts + i) for i in range(len(objects)) for a in range(parts)]
        terms = [(_HAND_IN_OBJECT, _OBJECT_IN_HAND)] * len(pairs)
        pairs += [(int(a), int(b)) for a, b in links.pairs]
        terms += [(_HAND_IN_HAND, _HAND_IN_HAND)] * len(links.pairs)
        pairs += [(parts + i, parts + len(objects) - 1) for i in range(len(objects) - 1)]
        terms += [(_HELD_IN_NEW, _NEW_IN_HELD)] * (len(objects) - 1)
        self._sums = PenetrationSums(
            [*links.solids, *(object_solid(o, object_points) for o in objects)],
            [*links.body, *(bodies + i for i in range(len(objects)))],
            np.array(pairs),
            np.array(terms),
            5,
            dtype=dtype,
            device=device,
        )
        self.culling = self._sums.culling
        self._grid = DistanceGrids([new.grid], dtype=dtype, device=device)
        self.normals = SurfaceNormals(new.grid, dtype=dtype, device=device)
        self._com = put(new.com)
        self._radius = new.radius
        self._by_hand = point_unit / sum(len(s.points) for s in links.solids)
        self._by_object = point_unit / object_points
        self.lower, self.upper = put(hand.tree.joint_lower), put(hand.tree.joint_upper)

    def __call__(
        self,
        R: torch.Tensor,
        t: torch.Tensor,
        q: torch.Tensor,
        contacts: HandContacts,
        held: tuple[torch.Tensor, torch.Tensor],
    ) -> torch.Tensor:
        """Energies (N, 6) in the order of TERMS.

        fc = |sum n|^2 + |sum (x - com) x n / radius|^2 with the object's normals n at the contact points x (Eq. 4, 5);
        dis = sum of distances of the contact points [m] (Eq. 6); hop, hsp, oop = mean depth of surface points, both
        ways, times point_unit [m]: hand and all objects, links that must stay apart, held objects and the new one
        (Eq. 7, 8, 10); joint = amounts beyond limits [rad or m] (Eq. 9).

        Args:
            R, t: pose of the object to grasp, (N, 3, 3) and (N, 3) [m].
            q: (N, K) [rad or m].
            held: poses of the objects held, (N, n - 1, 3, 3) and (N, n - 1, 3).
        """
        R_body, t_body = self.kinematics(q)
        frames = torch.cat([R_body, held[0], R[:, None]], 1), torch.cat([t_body, held[1], t[:, None]], 1)
        sums = self._sums(*frames)  # (N, 5)
        hop = self._by_hand * sums[:, _HAND_IN_OBJECT] + self._by_object * sums[:, _OBJECT_IN_HAND]
        hsp = self._by_hand * sums[:, _HAND_IN_HAND]
        oop = self._by_object * (sums[:, _NEW_IN_HELD] + sums[:, _HELD_IN_NEW])
        joint = ((q - self.upper).clamp_min(0) + (self.lower - q).clamp_min(0)).sum(1)
        x = self.contact_points(R, t, (R_body, t_body), contacts)
        fc, dis = self.balance(x, self.normals(x)), self.distance(x).abs().sum(1)
        return torch.stack([fc, dis, hop, hsp, joint, oop], 1)

    def contact_points(
        self, R: torch.Tensor, t: torch.Tensor, bodies: tuple[torch.Tensor, torch.Tensor], contacts: HandContacts
    ) -> torch.Tensor:
        """Contact points of the hand, with the bodies of ``kinematics``, in the frame of the object to grasp, (N, 2, 3)
        [m]."""
        R_body = torch.take_along_dim(bodies[0], contacts.body[..., None, None], 1)  # (N, 2, 3, 3)
        t_body = torch.take_along_dim(bodies[1], contacts.body[..., None], 1)
        p = (R_body * contacts.point[..., None, :]).sum(-1) + t_body - t[:, None]
        return (R[:, None] * p[..., None]).sum(-2)

    def distance(self, x: torch.Tensor) -> torch.Tensor:
        """Signed distance [m] of points (..., 3) of its frame to the object to grasp, negative inside."""
        return self._grid.value(x)

    def balance(self, x: torch.Tensor, n: torch.Tensor) -> torch.Tensor:
        """fc (N,) of contacts at x (N, 2, 3) with the object's outward normals n (N, 2, 3), frame of the object."""
        force = n.sum(1)
        torque = torch.linalg.cross((x - self._com) / self._radius, n).sum(1)
        return (force * force).sum(1) + (torque * torque).sum(1)
