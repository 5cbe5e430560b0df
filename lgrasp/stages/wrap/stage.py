"""wrap: realised contacts -> the same, with further links of their fingers on the object."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.contact_kernels import PalmarRuns
from lgrasp.grasp.find_contacts import palmar_runs
from lgrasp.grasp.structs import vec_further
from lgrasp.grasp.tables import CandidateTable
from lgrasp.hand.contact_surface import contact_surface
from lgrasp.refine.surface import farthest_points
from lgrasp.runtime.structs import make_struct
from lgrasp.runtime.tally import Tally, empty_tally
from lgrasp.stages.context import Context
from lgrasp.stages.wrap.kernels import WrapCount, list_realised, wrap_fingers
from lgrasp.stages.wrap.params import WrapParams
from lgrasp.stages.wrap.touch import WrapValues

VERSION = 3

_PROBES = 24  # points of a link from which its nearest one is looked for
_NORMAL_MARGIN = 2.0  # [deg] below the bound of the normals


def run(inputs: CandidateTable, params: WrapParams, context: Context) -> tuple[CandidateTable, Tally]:
    """Lay further links of fingers on the object, with the joints that a realised contact leaves free.

    Returns:
        The table with ``further`` contacts, and counts ``tried``, ``wrapped``.
    """
    d = context.device
    tally = empty_tally(WrapCount, d)
    table = replace(inputs, further=wp.empty(inputs.surface.shape, dtype=vec_further, device=d))
    values = wrap_values(params, context.bounds)
    asked = [context.hand.struct, context.field.struct, context.object.struct, context.held.struct, _probes(context)]
    shape, listed = inputs.surface.shape, wp.empty(inputs.surface.size, dtype=wp.int32, device=d)
    wp.launch(list_realised, shape, [table.struct], [listed, tally.device], device=d)
    wp.launch(wrap_fingers, listed.shape, [*asked, values, listed], [table.struct, tally.device], device=d)
    return table, tally


def wrap_values(params: WrapParams, bounds: GraspBounds) -> Any:
    """The struct WrapValues."""
    angles = {
        "cosine": bounds.max_normal_angle - _NORMAL_MARGIN,
        "min_cosine": bounds.max_normal_angle,
        "min_spread_cosine": bounds.max_normal_spread,
    }
    least = {name: math.cos(math.radians(angle)) for name, angle in angles.items()}
    return make_struct(WrapValues, params, bounds, **least)


def _probes(context: Context) -> PalmarRuns:
    """A few points of each link that may touch; made once for a job."""

    def make() -> PalmarRuns:
        side, allowed = contact_surface(context.hand.model), context.steered.touching.points
        chosen = []
        for link in dict.fromkeys(side.link[allowed].tolist()):
            own = np.flatnonzero(allowed & (side.link == link))
            chosen.append(np.unique(own[farthest_points(side.points[own], _PROBES)]))
        at = np.concatenate(chosen)
        return palmar_runs(context.hand, side, at)

    return context.once("wrap", make, context.steered)
