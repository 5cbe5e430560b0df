"""What the fingers can reach at poses, as a policy is told."""

from typing import NamedTuple

import numpy as np
import warp as wp

from lgrasp.grasp.tables import PoseTable
from lgrasp.runtime.fetch import to_numpy
from lgrasp.runtime.structs import empty_struct
from lgrasp.stages.context import Context
from lgrasp.stages.place.observe_kernels import ReachRows, find_all
from lgrasp.stages.place.rating import MAX_HITS


class Reach(NamedTuple):
    """Reachable contacts of P poses, those of a group side by side; base frame."""

    points: np.ndarray
    """(P, H, 3) [m]."""
    normals: np.ndarray
    """(P, H, 3)."""
    owner: np.ndarray
    """(P, H) group, -1 unused."""
    share: np.ndarray
    """(P, G) of the points drawn for a group that are hits."""
    distances: np.ndarray
    """(P, M) of the object [m]."""


def observe_reach(table: PoseTable, points: np.ndarray, samples: int, seed: int, context: Context) -> Reach:
    """Reachable contacts at poses, drawn anew from ``samples`` points of the object for each finger, and the object's
    distances at ``points`` (M, 3) [m]."""
    d, n, groups = context.device, table.index.shape[0], context.hand.model.groups
    given = {
        "owner": wp.full((n, MAX_HITS), -1, dtype=wp.int32, device=d),
        "share": wp.zeros((n, groups), dtype=wp.float32, device=d),
        "distances": wp.zeros((n, len(points)), dtype=wp.float32, device=d),
    }
    found = empty_struct(ReachRows, d, n, MAX_HITS, **given)
    hand, field, obj = context.hand.struct, context.field.struct, context.object.struct
    at = wp.array(points, dtype=wp.vec3, device=d)
    asked = [hand, field, obj, samples, context.steered.touching.bits, table.struct, at, seed]
    wp.launch(find_all, n, asked, [found], device=d)
    return Reach(*(to_numpy(getattr(found, name))[: len(table)] for name in Reach._fields))
