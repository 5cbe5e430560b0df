"""place: candidate indices -> object poses in the hand base frame that static links do not block."""

import numpy as np
import warp as wp

from lgrasp.errors import ConfigError
from lgrasp.grasp.tables import PoseTable
from lgrasp.stages.context import Context
from lgrasp.stages.place.kernels import choose_poses, propose_poses, take_poses
from lgrasp.stages.place.params import PlaceParams

__all__ = ["VERSION", "run"]

VERSION = 4


def run(inputs: tuple[int, int], params: PlaceParams, context: Context) -> tuple[PoseTable, dict[str, int]]:
    """Poses of candidates ``first .. first + count - 1`` of the shard's stream.

    Returns:
        The poses that can hold, in candidate order, and counts ``tried``, ``blocked`` (by static links), ``kept``.

    Raises:
        ConfigError: all weights are zero.
    """
    first, count = inputs
    total = params.canonical + params.exhaustive + params.pinch + params.palm
    if total <= 0:
        raise ConfigError("place: weights canonical, exhaustive, pinch and palm are all 0; one must be positive")
    d = context.device
    hand, obj = context.hand.struct, context.object.struct
    groups, shape = context.hand.model.groups, (count, params.proposals)
    pose = wp.empty(shape, dtype=wp.transform, device=d)
    palm_point, surface, setting, rating = (wp.empty(shape, dtype=wp.int32, device=d) for _ in range(4))
    anchor = wp.empty((*shape, groups), dtype=wp.int32, device=d)
    wp.launch(
        propose_poses,
        dim=shape,
        inputs=[
            hand,
            context.field.struct,
            obj,
            context.seed("place"),
            first,
            params.canonical / total,
            params.pinch / total,
            params.palm / total,
            params.samples,
            params.clearance,
        ],
        outputs=[pose, palm_point, surface, setting, anchor, rating],
        device=d,
    )
    chosen, best = (wp.empty(count, dtype=wp.int32, device=d) for _ in range(2))
    wp.launch(
        choose_poses, dim=count, inputs=[hand, obj, params.clearance, pose, rating], outputs=[chosen, best], device=d
    )
    rated = best.numpy()
    keep = np.flatnonzero(rated > 0).astype(np.int32)
    n = len(keep)
    table = PoseTable(
        index=wp.empty(n, dtype=wp.int32, device=d),
        pose=wp.empty(n, dtype=wp.transform, device=d),
        palm_point=wp.empty(n, dtype=wp.int32, device=d),
        palm_surface=wp.empty(n, dtype=wp.int32, device=d),
        setting=wp.empty(n, dtype=wp.int32, device=d),
        anchor=wp.empty((n, groups), dtype=wp.int32, device=d),
    )
    wp.launch(
        take_poses,
        dim=n,
        inputs=[
            wp.array(keep, dtype=wp.int32, device=d),
            chosen,
            first,
            pose,
            palm_point,
            surface,
            setting,
            anchor,
        ],
        outputs=[table.index, table.pose, table.palm_point, table.palm_surface, table.setting, table.anchor],
        device=d,
    )
    return table, {"tried": count, "blocked": int((rated < 0).sum()), "kept": n}
