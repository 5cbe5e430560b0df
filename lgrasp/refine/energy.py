"""The force-based surface matching energy with barriers, term by term."""

from typing import NamedTuple

import torch

from lgrasp.refine.links import Intrusions
from lgrasp.refine.params import LENGTH, LIMIT_SHARE, PARABOLA_BEND, PARABOLA_SLOPE, STEEPEST, LocalSearch


class Matches(NamedTuple):
    """What the points of a hand are matched to, frozen while the hand moves; N samples, L blocks of P points."""

    offset: torch.Tensor
    """Planes through the matched points: signed distance of x is normal . x - offset [m], (N, L, P)."""
    normal: torch.Tensor
    """Outward normals of the object there, (N, L, P, 3)."""
    pull: torch.Tensor
    """Weights of the points that are within reach, 0 else, (N, L, P)."""
    block_offset: torch.Tensor
    """The same planes of what the points must stay out of (the object, or what stands around it), (N, L, P)."""
    block_normal: torch.Tensor
    """(N, L, P, 3)."""
    contacts: torch.Tensor
    """Points, counted over L P, that the net wrench is made of, (N, C) int64."""
    intrusions: Intrusions
    """What is in the links, or nearly so."""


class Energies(NamedTuple):
    """Weighted terms of E*, (N,) each."""

    points: torch.Tensor
    normals: torch.Tensor
    force: torch.Tensor
    barrier: torch.Tensor
    overlap: torch.Tensor
    limits: torch.Tensor

    @property
    def total(self) -> torch.Tensor:
        """E*, (N,)."""
        return self.points + self.normals + self.force + self.barrier + self.overlap + self.limits


def barrier(u: torch.Tensor) -> torch.Tensor:
    """-(u - 1)^2 ln u of distances u (...) in units of the margin: 0 from u = 1 on, rising as u falls.

    Below a tenth it continues as the parabola of the same value, slope and curvature, so that points inside are pushed
    out the harder the deeper they are.
    """
    inside = u.clamp(STEEPEST, 1.0)
    v = (u - STEEPEST).clamp_max(0)
    return -((inside - 1) ** 2) * inside.log() + PARABOLA_SLOPE * v + 0.5 * PARABOLA_BEND * v * v


def matching_energies(
    x: torch.Tensor, m: torch.Tensor, matches: Matches, total_weight: float, params: LocalSearch
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """E_p, E_n and the barrier, weighted, (N,) each.

    E_p = sum W ((x - y) . n)^2 / sum W in cm^2; E_n = sum W (m . n + 1)^2 / sum W; the barrier is summed over all
    points.

    Args:
        x, m: points [m] and normals of the hand in the object's frame, (N, L, P, 3).
        total_weight: sum of the weights of all points of the hand.
    """
    s = ((x * matches.normal).sum(-1) - matches.offset) / LENGTH  # (N, L, P)
    points = (matches.pull * s * s).sum((1, 2)) * (params.points / total_weight)
    align = (m * matches.normal).sum(-1) + 1
    normals = (matches.pull * align * align).sum((1, 2)) * (params.normals / total_weight)
    u = ((x * matches.block_normal).sum(-1) - matches.block_offset) / params.margin
    return points, normals, params.barrier * barrier(u).sum((1, 2))


def intrusion_energies(
    object_distance: torch.Tensor, link_distance: torch.Tensor, params: LocalSearch
) -> tuple[torch.Tensor, torch.Tensor]:
    """Barriers of what is in the links: the object's points, and those of other links, weighted, (N,) each.

    Args:
        object_distance: (N, S, k) [m]. link_distance: (N, Q, k) [m].
    """
    of_object = barrier(object_distance / params.margin).sum((1, 2))
    of_links = barrier(link_distance / params.link_margin).sum((1, 2))
    return params.barrier * of_object, params.barrier * of_links


def wrench_energy(
    x: torch.Tensor, c: torch.Tensor, com: torch.Tensor, radius: float, params: LocalSearch
) -> torch.Tensor:
    """|G c|^2 / C^2, weighted, (N,): the net wrench of unit forces at C contacts.

    Args:
        x: contacts in the object's frame [m], (N, C, 3). c: inward normals of the object there, (N, C, 3).
        com: centre of mass [m], (3,); arms are about it and over ``radius`` [m].
    """
    force = c.sum(1)
    torque = torch.linalg.cross((x - com) / radius, c).sum(1)
    return ((force * force).sum(-1) + (torque * torque).sum(-1)) * (params.force / x.shape[1] ** 2)


def limit_energy(q: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor, params: LocalSearch) -> torch.Tensor:
    """Barrier at the joint limits, weighted, (N,): on signed distances, within 15 % of each range.

    Args:
        q: (N, K) [rad or m]. lower, upper: limits, (K,).
    """
    near = LIMIT_SHARE * (upper - lower).clamp_min(1e-6)
    return (barrier((q - lower) / near) + barrier((upper - q) / near)).sum(-1) * (params.limits / q.shape[1])
