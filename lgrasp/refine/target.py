"""What a hand is drawn to and kept out of: an object's distance grid in torch."""

import numpy as np
import torch
from torch.nn.functional import grid_sample

from lgrasp.differentiable.distance import SurfaceNormals
from lgrasp.object.model import ObjectModel
from lgrasp.refine.volume import solid_cloud


class Target:
    """An object, perhaps among others that are only kept out of, in the object's internal frame.

    Args:
        model: the object (of a mesh, or of a cloud: :func:`lgrasp.cloud.model.cloud_object`).
        around: what stands around it, in the same frame; None: nothing.
    """

    def __init__(
        self,
        model: ObjectModel,
        around: ObjectModel | None = None,
        *,
        dtype: torch.dtype = torch.float32,
        device: str | torch.device = "cpu",
    ) -> None:
        self._own = _Volume(model, dtype, device)
        self._other = None if around is None else _Volume(around, dtype, device)
        self.normals = SurfaceNormals(model.grid, dtype=dtype, device=device)
        """Outward unit normals (..., 3) at points (..., 3) [m]: smooth, differentiable."""
        solids = [model] if around is None else [model, around]
        self.model, self.around = model, around
        self.cloud = np.concatenate([solid_cloud(m) for m in solids])
        """Points of the surface of all that the hand is kept out of [m], (n, 3)."""
        self.com = torch.as_tensor(model.com, dtype=dtype, device=device)
        """Centre of mass [m], (3,)."""
        self.radius = model.radius
        """Largest distance of the surface from there [m]."""

    def nearest(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Signed distances d (...) [m] of points x (..., 3), and outward normals n (..., 3): x - d n is matched to x.

        Where the sign is not to be trusted (deep behind what was seen of a cloud) d is positive.
        """
        return self._own.nearest(x)

    def nearest_obstacle(self, x: torch.Tensor, d: torch.Tensor, n: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As :meth:`nearest`, of whatever is nearest to x, given what :meth:`nearest` says of the object itself."""
        if self._other is None:
            return d, n
        other_d, other_n = self._other.nearest(x)
        closer = other_d < d
        return torch.where(closer, other_d, d), torch.where(closer[..., None], other_n, n)


class _Volume:
    """Slope and value of a distance grid at its nodes, interpolated trilinearly; no derivatives."""

    def __init__(self, model: ObjectModel, dtype: torch.dtype, device: str | torch.device) -> None:
        grid = model.grid
        nodes = np.stack([*np.gradient(grid.values, grid.cell), grid.values])
        self._nodes = torch.as_tensor(nodes, dtype=dtype, device=device)[None]  # (1, 4, nx, ny, nz)
        low = torch.as_tensor(grid.origin, dtype=dtype, device=device)
        size = torch.as_tensor((np.array(grid.values.shape) - 1) * grid.cell, dtype=dtype, device=device)
        self._low, self._high, self._scale = low, low + size, 2 / size

    @torch.no_grad()
    def nearest(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        inside = x.maximum(self._low).minimum(self._high)
        at = ((inside - self._low) * self._scale - 1).flip(-1).reshape(1, -1, 1, 1, 3)
        mixed = grid_sample(self._nodes, at, align_corners=True, padding_mode="border")[0, :, :, 0, 0]
        slope, d = mixed[:3].mT.reshape(x.shape), mixed[3].reshape(x.shape[:-1])
        n = slope / slope.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        # beyond the grid: from the surface as seen from the nearest point of the grid
        beyond = x - inside
        way = beyond + n * d.clamp_min(0)[..., None]
        far = way.norm(dim=-1)
        out = (beyond != 0).any(-1)
        return torch.where(out, far, d), torch.where(out[..., None], way / far.clamp_min(1e-9)[..., None], n)
