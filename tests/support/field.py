"""Queries of a contact field, one by one: is there a contact vector at this point along this normal, and which?"""

import numpy as np
import warp as wp

from lgrasp.field.arrays import Boxes, Field, FieldArrays, boxes_pick, field_has, field_pick
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def query_voxels(
    f: Field,
    seed: wp.int32,
    cosine: wp.float32,
    slot: wp.array(dtype=wp.int32),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    record_out: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    record_out[i] = -1
    row = field_has(f, slot[i], point[i], normal[i])
    if row >= 0:
        pick = field_pick(f, slot[i], row, point[i], normal[i], wp.rand_init(seed, i))
        if float(pick[1]) * 0.0001 >= cosine:
            record_out[i] = pick[0]


@wp.kernel
def query_boxes(
    b: Boxes,
    f: Field,
    seed: wp.int32,
    cosine: wp.float32,
    slot: wp.array(dtype=wp.int32),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    record_out: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    record_out[i] = boxes_pick(b, f, slot[i], point[i], normal[i], cosine, wp.rand_init(seed, i))


def query_field(
    field: FieldArrays,
    slot: np.ndarray,
    point: np.ndarray,
    normal: np.ndarray,
    *,
    angle: float,
    index: str = "voxel",
    seed: int = 0,
) -> np.ndarray:
    """Which contact vector of its slot meets each query? One interface for both indices.

    Args:
        slot: (N,), ``setting * groups + group``; the group itself for a hand without shared joints.
        point: base frame [m], (N, 3). normal: unit hand normal wanted, (N, 3).
        angle: largest angle between wanted and found normal [rad].
        index: ``voxel``, or ``bvh`` for a field that was built with it.

    Returns:
        Row of the field, -1 where none, (N,) i32.
    """
    d = field.device
    out = wp.empty(len(point), dtype=wp.int32, device=d)
    queries = [
        seed,
        float(np.cos(angle)),
        wp.array(np.asarray(slot, np.int32), dtype=wp.int32, device=d),
        wp.array(np.asarray(point, np.float32), dtype=wp.vec3, device=d),
        wp.array(np.asarray(normal, np.float32), dtype=wp.vec3, device=d),
    ]
    if index == "bvh":
        if field.boxes is None:
            raise ValueError("the field has no boxes; build it with index 'bvh'")
        wp.launch(query_boxes, len(point), [field.boxes, field.struct, *queries], [out], device=d)
    else:
        wp.launch(query_voxels, len(point), [field.struct, *queries], [out], device=d)
    return out.numpy()
