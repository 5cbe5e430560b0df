"""A ContactField on a device and its query: is there a contact vector at this point along this normal, and which?"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.device.kinematics import Kinematics, vec_dof
from lgrasp.device.runtime import KERNEL_OPTIONS
from lgrasp.device.transforms import decode_normal, normal_bin
from lgrasp.field.model import ContactField

__all__ = ["Field", "FieldArrays", "field_has", "field_pick", "field_seed", "upload_field"]

wp.set_module_options(KERNEL_OPTIONS)

_TRIES = wp.constant(6)


@wp.struct
class Field:
    """Voxel index of a ContactField (same names, same meaning)."""

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


@dataclass(frozen=True)
class FieldArrays:
    """A contact field and its copy on one device."""

    model: ContactField
    device: str
    struct: "Field"


def upload_field(model: ContactField, device: str) -> FieldArrays:
    """Copy a field to a device."""

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
    return FieldArrays(model, device, field)


@wp.func
def field_has(f: Field, group: wp.int32, p: wp.vec3, n: wp.vec3):
    """Table row of (voxel of p, normal bin of n) when it holds contact vectors of the group, else -1.

    p [m] and n (hand normal) are in the base frame.
    """
    x = (p - f.origin[group]) * f.inv_cell
    s = f.shape[group]
    if x[0] < 0.0 or x[1] < 0.0 or x[2] < 0.0:
        return int(-1)
    i = int(x[0])
    j = int(x[1])
    k = int(x[2])
    if i >= s[0] or j >= s[1] or k >= s[2]:
        return int(-1)
    v = f.cell_first[group] + (i * s[1] + j) * s[2] + k
    bits = f.mask[v]
    if bits == wp.uint64(0):
        return int(-1)
    b = normal_bin(n)
    if ((bits >> wp.uint64(b)) & wp.uint64(1)) == wp.uint64(0):
        return int(-1)
    return v * 64 + b


@wp.func
def field_pick(f: Field, group: wp.int32, row: wp.int32, p: wp.vec3, n: wp.vec3, state: wp.uint32):
    """The best of a few contact vectors of a table row: (index, cosine of its normal to n)."""
    a = f.start[row]
    count = f.start[row + 1] - a
    v = row // 64 - f.cell_first[group]
    s = f.shape[group]
    x = (p - f.origin[group]) * f.inv_cell
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
def field_seed(f: Field, h: Kinematics, group: wp.int32, record: wp.int32):
    """Joint seed of a contact vector [rad or m]."""
    first = h.dof_first[group]
    q = vec_dof()
    for d in range(h.dof_first[group + 1] - first):
        low = h.dof_lower[first + d]
        q[d] = low + (h.dof_upper[first + d] - low) * float(int(f.posture[record, d])) / 255.0
    return q
