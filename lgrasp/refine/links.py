"""Links of a hand as solids: what of the object, or of other links, is in them or nearly so."""

from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from lgrasp.differentiable.distance import DistanceGrids
from lgrasp.differentiable.solids import hand_solids
from lgrasp.hand.model import HandModel
from lgrasp.refine.match_kernels import DEEPEST, LINK_DEEPEST, NO_PLANE
from lgrasp.refine.surface import LINK_POINTS, link_probes


class Intrusions(NamedTuple):
    """Planes in the frames of links, and the points to keep beyond them; S links, Q pairs of links."""

    points: torch.Tensor
    """The deepest points of the object in each link, object's frame [m], (N, S, k, 3)."""
    normal: torch.Tensor
    """Outward normal of the link there, link body's frame, (N, S, k, 3)."""
    offset: torch.Tensor
    """Signed distance of p is normal . p - offset [m], (N, S, k)."""
    link_points: torch.Tensor
    """The deepest points of the first link of each pair in the second, frame of the first, (N, Q, k, 3)."""
    link_normal: torch.Tensor
    """Of the second link, its body's frame, (N, Q, k, 3)."""
    link_offset: torch.Tensor
    """(N, Q, k)."""


class LinkSolids:
    """The links of a hand with their distance grids, before points of an object, in its internal frame, (n, 3) [m]."""

    def __init__(
        self, model: HandModel, cloud: np.ndarray, margin: float, *, dtype: torch.dtype, device: str | torch.device
    ) -> None:
        self.solids = solids = hand_solids(model, LINK_POINTS)
        put = partial(torch.as_tensor, dtype=dtype, device=device)
        self._margin = margin
        self._grids = DistanceGrids([s.grid for s in solids.solids], dtype=dtype, device=device)
        self._body = torch.as_tensor(solids.body, dtype=torch.int64, device=device)
        balls = np.stack([s.ball for s in solids.solids])
        self._centre, self._radius = put(balls[:, :3].copy()), put(balls[:, 3].copy())
        self._cloud = put(cloud)
        self._points = put(np.stack([link_probes(s.points) for s in solids.solids]))
        pairs = np.concatenate([solids.pairs, solids.pairs[:, ::-1]])
        self._pairs = torch.as_tensor(np.ascontiguousarray(pairs), dtype=torch.int64, device=device)

    @torch.no_grad()
    def match(self, R: torch.Tensor, t: torch.Tensor, body_R: torch.Tensor, body_t: torch.Tensor) -> Intrusions:
        """Planes at the deepest points of hands; rotations R (N, 3, 3) and positions t (N, 3) of bases in the object's
        frame, body_R (N, B, 3, 3) and body_t (N, B, 3) of bodies in the base frame."""
        link_R, link_t = body_R[:, self._body], body_t[:, self._body]  # (N, S, 3, 3)
        centre = (link_R @ self._centre[..., None])[..., 0] + link_t
        cloud = (self._cloud - t[:, None]) @ R  # (N, n, 3)
        return Intrusions(
            *self._object_planes(cloud, link_R, link_t, centre), *self._link_planes(link_R, link_t, centre)
        )

    def _object_planes(
        self, cloud: torch.Tensor, link_R: torch.Tensor, link_t: torch.Tensor, centre: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        apart = torch.cdist(centre, cloud, compute_mode="donot_use_mm_for_euclid_dist")  # (N, S, n)
        row, link, point = (apart < (self._radius + self._margin)[:, None]).nonzero().unbind(1)
        p = _into(link_R[row, link], link_t[row, link], cloud[row, point])
        d, _ = self._distance(p, link)
        depth = torch.full_like(apart, torch.inf)
        depth[row, link, point] = d
        best = depth.topk(DEEPEST, dim=2, largest=False)
        rows = torch.arange(len(cloud), device=cloud.device)[:, None, None]
        p = _into(link_R[:, :, None], link_t[:, :, None], cloud[rows, best.indices])  # (N, S, k, 3)
        normal, offset = self._planes(p, torch.arange(len(self._body), device=p.device)[:, None])
        return self._cloud[best.indices], normal, torch.where(best.values.isinf(), NO_PLANE, offset)

    def _link_planes(
        self, link_R: torch.Tensor, link_t: torch.Tensor, centre: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        a, b = self._pairs.T
        near = (centre[:, a] - centre[:, b]).norm(dim=-1) < self._radius[a] + self._radius[b] + self._margin
        row, pair = near.nonzero().unbind(1)
        first, second = a[pair], b[pair]
        p = (link_R[row, first, None] @ self._points[first][..., None])[..., 0] + link_t[row, first, None]
        p = _into(link_R[row, second, None], link_t[row, second, None], p)  # (E, probes, 3)
        d, _ = self._distance(p, second[:, None])
        near = d.amin(1) < self._margin
        row, pair, first, second, p, d = (x[near] for x in (row, pair, first, second, p, d))
        best = d.topk(LINK_DEEPEST, dim=1, largest=False).indices
        normal, offset = self._planes(p.gather(1, best[..., None].expand(-1, -1, 3)), second[:, None])
        shape = (len(centre), len(a), LINK_DEEPEST)
        points = centre.new_zeros((*shape, 3))
        normals, offsets = torch.zeros_like(points), centre.new_full(shape, NO_PLANE)
        points[row, pair] = self._points[first[:, None], best]
        normals[row, pair], offsets[row, pair] = normal, offset
        return points, normals, offsets

    def _distance(
        self, p: torch.Tensor, link: torch.Tensor
    ) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        x, y, z = p.unbind(-1)
        return self._grids.value_and_gradient((x, y, z), link)

    def _planes(self, p: torch.Tensor, link: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        d, slope = self._distance(p, link)
        normal = torch.stack(slope, -1)
        normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        return normal, (normal * p).sum(-1) - d

    def distances(
        self, found: Intrusions, R: torch.Tensor, t: torch.Tensor, body_R: torch.Tensor, body_t: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Signed distances [m] of the points from their planes, differentiable by the poses: of the object's (N, S, k),
        and of links' (N, Q, k)."""
        link_R, link_t = body_R[:, self._body], body_t[:, self._body]
        base = (found.points - t[:, None, None]) @ R[:, None]  # (N, S, k, 3)
        own = (base - link_t[:, :, None]) @ link_R
        a, b = self._pairs.T
        moved = found.link_points @ link_R[:, a].mT + (link_t[:, a] - link_t[:, b])[:, :, None]
        other = moved @ link_R[:, b]
        return (own * found.normal).sum(-1) - found.offset, (other * found.link_normal).sum(-1) - found.link_offset


def _into(R: torch.Tensor, t: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
    """R^T (p - t) of points (..., 3)."""
    return ((p - t)[..., None, :] @ R)[..., 0, :]
