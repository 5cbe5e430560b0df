"""A ContactField on a device and its query: is there a contact vector at this point along this normal, and which?"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.field.model import ContactField
from lgrasp.hand.model import HandModel
from lgrasp.math.kinematics import Kinematics, vec_dof
from lgrasp.math.transforms import decode_normal, normal_bin
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_TRIES = wp.constant(6)


@wp.struct
class Field:
    """Voxel index of a ContactField (same names, same meaning); a slot is ``setting * groups + group``."""

    cell: wp.float32
    inv_cell: wp.float32
    origin: wp.array(dtype=wp.vec3)
    shape: wp.array(dtype=wp.vec3i)
    cell_first: wp.array(dtype=wp.int32)
    start: wp.array(dtype=wp.int32)
    mask: wp.array(dtype=wp.uint64)
    point: wp.array(dtype=wp.int32)
    offset: wp.array(dtype=wp.int32)
    normal: wp.array(dtype=wp.uint16)
    posture: wp.array2d(dtype=wp.uint8)
    pair_point: wp.array2d(dtype=wp.vec3)
    pair_normal: wp.array2d(dtype=wp.vec3)
    pair_slot: wp.array(dtype=wp.vec2i)
    pair_width: wp.array(dtype=wp.float32)


@wp.struct
class Boxes:
    """Published index of a ContactField: one bounding-volume hierarchy per patch over its occupied boxes."""

    slot_first: wp.array(dtype=wp.int32)  # (slots + 1,) patches of each slot
    tree: wp.array(dtype=wp.uint64)  # one wp.Bvh per patch
    patch_first: wp.array(dtype=wp.int32)
    leaf_first: wp.array(dtype=wp.int32)
    leaf_record: wp.array(dtype=wp.int32)


@dataclass(frozen=True)
class FieldArrays:
    """A contact field and its copy on one device; keeps the trees alive."""

    model: ContactField
    device: str
    struct: "Field"
    boxes: "Boxes | None" = None
    trees: tuple[wp.Bvh, ...] = ()


def upload_field(model: ContactField, hand: HandModel, device: str) -> FieldArrays:
    """Copy the field of a hand to a device; trees are built when the field has boxes."""

    def put(a: np.ndarray, dtype) -> wp.array:
        return wp.array(np.ascontiguousarray(a), dtype=dtype, device=device)

    field = Field()
    field.cell = model.cell
    field.inv_cell = 1.0 / model.cell
    field.origin = put(model.origin, wp.vec3)
    field.shape = put(model.shape, wp.vec3i)
    field.cell_first = put(model.cell_first, wp.int32)
    field.start = put(model.start, wp.int32)
    field.mask = put(model.mask, wp.uint64)
    field.point = put(model.point, wp.int32)
    field.offset = put(model.offset, wp.int32)
    field.normal = put(model.normal, wp.uint16)
    field.posture = put(model.posture, wp.uint8)
    field.pair_point = put(model.pair_point, wp.vec3)
    field.pair_normal = put(model.pair_normal, wp.vec3)
    field.pair_slot = put(model.pair_slot, wp.vec2i)
    field.pair_width = put(model.pair_width, wp.float32)
    if len(model.box) == 0:
        return FieldArrays(model, device, field)
    trees, ids = [], []
    for a, b in zip(model.patch_first[:-1], model.patch_first[1:], strict=True):
        if a == b:
            ids.append(0)
            continue
        trees.append(wp.Bvh(put(model.box[a:b], wp.vec3), put(model.box[a:b] + np.float32(model.box_edge), wp.vec3)))
        ids.append(trees[-1].id)
    boxes = Boxes()
    settings = np.arange(len(hand.tree.settings))[:, None] * hand.patches
    slot_first = np.append(settings + hand.patch_first[:-2], len(settings) * hand.patches)
    boxes.slot_first = put(slot_first, wp.int32)
    boxes.tree = put(np.array(ids, np.uint64), wp.uint64)
    boxes.patch_first = put(model.patch_first, wp.int32)
    boxes.leaf_first = put(model.leaf_first, wp.int32)
    boxes.leaf_record = put(model.leaf_record, wp.int32)
    return FieldArrays(model, device, field, boxes, tuple(trees))


@wp.func
def field_has(f: Field, slot: wp.int32, p: wp.vec3, n: wp.vec3):
    """Table row of (voxel of p, normal bin of n) when it holds contact vectors of the slot, else -1.

    p [m] and n (hand normal) are in the base frame.
    """
    x = (p - f.origin[slot]) * f.inv_cell
    s = f.shape[slot]
    if x[0] < 0.0 or x[1] < 0.0 or x[2] < 0.0:
        return int(-1)
    i = int(x[0])
    j = int(x[1])
    k = int(x[2])
    if i >= s[0] or j >= s[1] or k >= s[2]:
        return int(-1)
    v = f.cell_first[slot] + (i * s[1] + j) * s[2] + k
    bits = f.mask[v]
    if bits == wp.uint64(0):
        return int(-1)
    b = normal_bin(n)
    if ((bits >> wp.uint64(b)) & wp.uint64(1)) == wp.uint64(0):
        return int(-1)
    return v * 64 + b


@wp.func
def field_pick(f: Field, slot: wp.int32, row: wp.int32, p: wp.vec3, n: wp.vec3, state: wp.uint32):
    """The best of a few contact vectors of a table row: (index, cosine of its normal to n)."""
    a = f.start[row]
    count = f.start[row + 1] - a
    v = row // 64 - f.cell_first[slot]
    s = f.shape[slot]
    x = (p - f.origin[slot]) * f.inv_cell
    corner = wp.vec3(float(v // (s[1] * s[2])), float((v // s[2]) % s[1]), float(v % s[2]))
    local = (x - corner) * 256.0
    best = float(1.0e30)
    pick = a
    cosine = float(0.0)
    for t in range(wp.min(count, _TRIES)):
        r = a + t
        if count > _TRIES:
            r = a + wp.min(int(wp.randf(state) * float(count)), count - 1)
        o = f.offset[r]
        d = local - wp.vec3(float(o >> 16), float((o >> 8) & 255), float(o & 255))
        c = wp.dot(n, decode_normal(int(f.normal[r])))
        # 2 mm weighs like 10 degrees
        e = wp.dot(d, d) * (f.cell * f.cell / (65536.0 * 4.0e-6)) + (1.0 - c) * 65.0
        if e < best:
            best = e
            pick = r
            cosine = c
    return wp.vec2i(pick, int(cosine * 10000.0))


@wp.func
def field_pair(f: Field, width: wp.float32, slack: wp.float32, u: wp.float32):
    """A pair of opposed contact vectors with distance within ``slack`` of ``width`` [m], or -1; u in [0, 1) picks."""
    a = wp.lower_bound(f.pair_width, width - slack)
    b = wp.lower_bound(f.pair_width, width + slack)
    if b <= a:
        return int(-1)
    return a + wp.min(int(u * float(b - a)), b - a - 1)


@wp.func
def boxes_pick(b: Boxes, f: Field, slot: wp.int32, p: wp.vec3, n: wp.vec3, cosine: wp.float32, state: wp.uint32):
    """The best aligned contact vector of a random patch whose box at p holds a normal within ``cosine`` of n, or -1."""
    pick = int(-1)
    hits = int(0)
    for patch in range(b.slot_first[slot], b.slot_first[slot + 1]):
        first = b.patch_first[patch]
        if b.patch_first[patch + 1] > first:
            query = wp.bvh_query_aabb(b.tree[patch], p, p)
            leaf = int(0)
            best = cosine
            found = int(-1)
            while wp.bvh_query_next(query, leaf):
                for i in range(b.leaf_first[first + leaf], b.leaf_first[first + leaf + 1]):
                    r = b.leaf_record[i]
                    c = wp.dot(n, decode_normal(int(f.normal[r])))
                    if c >= best:
                        best = c
                        found = r
            if found >= 0:
                hits += 1
                if int(wp.randf(state) * float(hits)) == 0:
                    pick = found
    return pick


@wp.func
def field_seed(f: Field, h: Kinematics, slot: wp.int32, record: wp.int32):
    """Joint seed of a contact vector of a slot [rad or m]; shared joints have exactly their value in the setting."""
    setting = slot // h.groups
    group = slot - setting * h.groups
    first = h.dof_first[group]
    free = h.dof_free[group]
    q = vec_dof()
    for d in range(h.dof_first[group + 1] - first):
        if d >= free:
            q[d] = h.dof_setting[setting, first + d]
            continue
        low = h.dof_lower[first + d]
        q[d] = low + (h.dof_upper[first + d] - low) * float(int(f.posture[record, d])) / 255.0
    return q


@wp.kernel
def _query_voxels(
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
def _query_boxes(
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
        wp.launch(_query_boxes, len(point), [field.boxes, field.struct, *queries], [out], device=d)
    else:
        wp.launch(_query_voxels, len(point), [field.struct, *queries], [out], device=d)
    return out.numpy()
