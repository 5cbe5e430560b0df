"""An object whose contact points are drawn as regions ask."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lgrasp.errors import ConfigError
from lgrasp.geometry.shares import entries_of
from lgrasp.object.model import ObjectModel, SteeredObject, SurfaceWeights
from lgrasp.object.region_text import Region
from lgrasp.object.regions import MEMBER, region_weights
from lgrasp.object.surface import opposite_points

_DRAWS = 8192  # entries among which points of unequal weight are drawn


def surface_weights(model: ObjectModel, touch: Sequence[Region], avoid: Sequence[Region], mesh: Path) -> SurfaceWeights:
    """What regions ask of an object.

    Args:
        mesh: the object's file.

    Raises:
        ConfigError, ObjectError: see :func:`~lgrasp.object.regions.region_weights`.
    """
    points = (model.contact_points + model.center).astype(np.float32)
    both = [region_weights(regions, points, mesh, scale=model.scale) if regions else None for regions in (touch, avoid)]
    return SurfaceWeights(points, both[0], both[1], min((region.share for region in touch), default=1.0))


def stored_weights(model: ObjectModel, regions: np.ndarray, share: float) -> SurfaceWeights:
    """What a shard says of regions (:meth:`SurfaceWeights.table`, (S, 5)), for contact points of the same object."""
    points = (model.contact_points + model.center).astype(np.float32)
    touch, avoid = SurfaceWeights(regions[:, :3], regions[:, 3], regions[:, 4], share).near(points).T
    return SurfaceWeights(points, touch, avoid, share)


def steer_object(model: ObjectModel, weights: SurfaceWeights, *, seed: int = 0) -> SteeredObject:
    """An object of whose contact points only those are left that may be touched.

    Where all contacts must be on ``touch`` only its points are left, in proportion to their weights. With a share the
    others are there too: that part of the draws is on ``touch``, unless it has more of the surface.

    Raises:
        ConfigError: no point is left, in one line.
    """
    n = len(model.contact_points)
    touch, avoid = weights.table()[:, 3:].astype(float).T
    on, open_ = touch >= MEMBER, np.where(avoid >= MEMBER, 0.0, 1.0 - avoid)
    asked = open_ * np.where(on, touch, 0.0)
    if not asked.any():
        raise ConfigError(
            f"object '{model.name}': --avoid leaves none of the {int(on.sum()):,} surface points that may be touched; "
            f"a smaller region is accepted"
        )
    rest = open_ * ~on if weights.share < 1.0 else np.zeros(n)
    if rest.any():
        asked *= max(1.0, weights.share / (1.0 - weights.share) * rest.sum() / asked.sum())
    density = asked + rest
    often = (density > 0).astype(int)
    if np.ptp(density[density > 0]) > 1e-6 * density.max():
        often = entries_of(density, max(_DRAWS, 2 * n))
    rows = np.repeat(np.arange(n), often)
    points, normals = model.contact_points[rows], model.contact_normals[rows]
    opposite = opposite_points(points, normals, seed=seed)
    left = replace(model, contact_points=points, contact_normals=normals, contact_opposite=opposite)
    return SteeredObject(left, weights, on[rows])
