"""place: candidate indices -> object poses in the hand base frame that static links do not block."""

import numpy as np
import warp as wp

from lgrasp.errors import ConfigError
from lgrasp.grasp.tables import PoseTable
from lgrasp.stages.context import Context
from lgrasp.stages.place.kernels import place_objects
from lgrasp.stages.place.params import PlaceParams

__all__ = ["VERSION", "run"]

VERSION = 2


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
    pose = wp.empty(count, dtype=wp.transform, device=d)
    anchor = wp.empty((count, context.hand.model.groups), dtype=wp.int32, device=d)
    palm_point, palm_surface, setting, rating = (wp.empty(count, dtype=wp.int32, device=d) for _ in range(4))
    wp.launch(
        place_objects,
        dim=count,
        inputs=[
            context.hand.struct,
            context.field.struct,
            context.object.struct,
            context.seed("place"),
            first,
            params.canonical / total,
            params.pinch / total,
            params.palm / total,
            params.proposals,
            params.samples,
            params.clearance,
        ],
        outputs=[pose, palm_point, palm_surface, setting, anchor, rating],
        device=d,
    )
    rated = rating.numpy()
    keep = np.flatnonzero(rated > 0).astype(np.int32)
    table = PoseTable(
        index=wp.array(keep + first, dtype=wp.int32, device=d),
        pose=wp.array(pose.numpy()[keep], dtype=wp.transform, device=d),
        palm_point=wp.array(palm_point.numpy()[keep], dtype=wp.int32, device=d),
        palm_surface=wp.array(palm_surface.numpy()[keep], dtype=wp.int32, device=d),
        setting=wp.array(setting.numpy()[keep], dtype=wp.int32, device=d),
        anchor=wp.array(anchor.numpy()[keep], dtype=wp.int32, device=d),
    )
    return table, {"tried": count, "blocked": int((rated < 0).sum()), "kept": len(keep)}
