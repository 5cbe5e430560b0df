"""close: poses -> contacts that fingers make as they close."""

from dataclasses import replace

import numpy as np
import warp as wp

from lgrasp.grasp.contact_kernels import PalmarRuns
from lgrasp.grasp.predicted import record_of_points
from lgrasp.grasp.structs import vec_further
from lgrasp.grasp.tables import CandidateTable, PoseTable
from lgrasp.runtime.fetch import to_numpy
from lgrasp.runtime.structs import make_struct
from lgrasp.runtime.tally import Tally, empty_tally
from lgrasp.stages.close.kernels import CloseCount, CloseValues, close_fingers
from lgrasp.stages.close.params import CloseParams
from lgrasp.stages.context import Context
from lgrasp.stages.filter.stage import allowed_runs
from lgrasp.stages.wrap.params import WrapParams
from lgrasp.stages.wrap.stage import wrap_values

VERSION = 4

_REACH = 0.01  # [m] of links from the object where a finger meets it: others are not those that meet it


def run(inputs: PoseTable, params: CloseParams, context: Context) -> tuple[CandidateTable, Tally]:
    """Close each finger, wide open at first, until it touches the object.

    A finger of one joint can make one contact where an object is, and few of those that are drawn on its surface.

    Returns:
        One realised contact at most of each finger, and counts ``tried``, ``touching``.
    """
    d, n, groups = context.device, inputs.index.shape[0], context.hand.model.groups
    tally = empty_tally(CloseCount, d)
    none = wp.empty((0, 0, 0), dtype=vec_further, device=d)
    table = CandidateTable.empty(d, n, groups, 1, poses=replace(inputs, setting=wp.clone(inputs.setting)), further=none)
    shared = params.model_dump(include={*WrapParams.model_fields})
    values = wrap_values(WrapParams(**shared, reach=_REACH), context.bounds)
    runs = allowed_runs(context)
    closing = make_struct(CloseValues, params, context.bounds, record=_records(runs, context))
    asked = [context.hand.struct, context.object.struct, runs, values, closing]
    wp.launch(close_fingers, n, asked, [table.struct, table.poses.setting, tally.device], device=d)
    return table, tally


def _records(runs: PalmarRuns, context: Context) -> wp.array:
    """A contact vector of the field for each run, of some point of its link; made once for a job."""

    def make() -> wp.array:
        model = context.hand.model
        record = record_of_points(model, context.field.model)
        some = [record[model.contact_link == k].max() for k in to_numpy(runs.link)]
        return wp.array(np.array(some), dtype=wp.int32, device=context.device)

    return context.once("close", make, context.steered)
