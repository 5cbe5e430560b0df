"""A ContactField on a device, and the query of kernels: whether there is a contact vector here along this normal."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.field.kernels import stored_posture
from lgrasp.field.model import ContactField
from lgrasp.hand.model import HandModel
from lgrasp.math.kinematics import Kinematics
from lgrasp.math.transforms import decode_normal, normal_bin
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.structs import upload_struct

wp.set_module_options(KERNEL_OPTIONS)

_TRIES = wp.constant(6)


@wp.struct
class Field:
    """Voxel index of a ContactField (same names, same meaning); a slot is ``setting * groups + group``."""

    cell: wp.float32
    inv_cell: wp.float32
    origin: wp.array(dtype=wp.vec3)  # (slots,) [m]
    shape: wp.array(dtype=wp.vec3i)  # (slots,)
    cell_first: wp.array(dtype=wp.int32)  # (slots + 1,)
    start: wp.array(dtype=wp.int32)  # (64 cells + 1,)
    mask: wp.array(dtype=wp.uint64)  # (cells,)
    point: wp.array(dtype=wp.int32)  # (records,)
    offset: wp.array(dtype=wp.int32)  # (records,)
    normal: wp.array(dtype=wp.uint16)  # (records,)
    posture: wp.array2d(dtype=wp.uint8)  # (records, D)
    pair_point: wp.array2d(dtype=wp.vec3)  # (pairs, 2) [m]
    pair_normal: wp.array2d(dtype=wp.vec3)  # (pairs, 2)
    pair_slot: wp.array(dtype=wp.vec2i)  # (pairs,)
    pair_width: wp.array(dtype=wp.float32)  # (pairs,) [m], rising


@wp.struct
class Boxes:
    """Published index of a ContactField: one bounding-volume hierarchy per patch over its occupied boxes."""

    slot_first: wp.array(dtype=wp.int32)  # (slots + 1,) patches of each slot
    tree: wp.array(dtype=wp.uint64)  # (patches,) one wp.Bvh each
    patch_first: wp.array(dtype=wp.int32)  # (patches + 1,)
    leaf_first: wp.array(dtype=wp.int32)  # (leaves + 1,)
    leaf_record: wp.array(dtype=wp.int32)  # (records,)


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
    same = {name: getattr(model, name) for name in Field.vars if name != "inv_cell"}
    field = upload_struct(Field, device, same | {"inv_cell": 1.0 / model.cell})
    if len(model.box) == 0:
        return FieldArrays(model, device, field)
    trees, ids = [], []
    for a, b in zip(model.patch_first[:-1], model.patch_first[1:], strict=True):
        if a == b:
            ids.append(0)
            continue
        ends = (model.box[a:b], model.box[a:b] + np.float32(model.box_edge))
        trees.append(wp.Bvh(*(wp.array(end, dtype=wp.vec3, device=device) for end in ends)))
        ids.append(trees[-1].id)
    settings = np.arange(hand.surfaces * len(hand.tree.settings))
    own = settings // len(hand.tree.settings) * (hand.groups + 1)
    arrays = {name: getattr(model, name) for name in ("patch_first", "leaf_first", "leaf_record")}
    arrays["slot_first"] = np.append(
        settings[:, None] * hand.patches + hand.patch_first[own[:, None] + np.arange(hand.groups)],
        len(settings) * hand.patches,
    )
    boxes = upload_struct(Boxes, device, arrays | {"tree": np.array(ids, np.uint64)})
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
    return stored_posture(h, slot - setting * h.groups, setting, f.posture, record)
