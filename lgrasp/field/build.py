"""Hand -> ContactField: postures are drawn, the contact vectors that they make are sorted into voxels and boxes."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from lgrasp.errors import HandError
from lgrasp.field.kernels import Vectors, contact_vectors, sample_postures
from lgrasp.field.model import ContactField
from lgrasp.field.opposed import opposed_pairs
from lgrasp.field.params import FieldParams
from lgrasp.hand.arrays import HandArrays, upload_hand
from lgrasp.hand.model import HandModel
from lgrasp.hand.params import ThumbBend
from lgrasp.math.transforms import NORMAL_BINS
from lgrasp.runtime.cores import cores
from lgrasp.runtime.fetch import to_numpy
from lgrasp.runtime.ordered import in_order
from lgrasp.runtime.structs import empty_struct


def box_index(position: np.ndarray, patch: np.ndarray, patches: int, params: FieldParams) -> dict[str, Any]:
    """Box arrays of a ContactField; empty ones when ``params.index`` is not ``bvh``.

    Args:
        position: contact vectors' positions [m], shape (N, 3).
        patch: their patches, shape (N,).
        patches: number of patches of the hand.
    """
    if params.index != "bvh":
        first, box = np.zeros(patches + 1, np.int32), np.zeros((0, 3), np.float32)
        none = {"leaf_first": first[:1], "leaf_record": first[:0]}
        return {"box_edge": params.box, "patch_first": first, "box": box, **none}
    place = np.floor(position / params.box).astype(np.int64)
    low = place.min(0)
    size = place.max(0) - low + 1
    key = np.ravel_multi_index((patch, *(place - low).T), (patches, *size))
    order = np.argsort(key, kind="stable")
    boxes, first, number = np.unique(key[order], return_index=True, return_counts=True)
    # at most leaf_normals vectors a box, spread over those there are
    kept = np.minimum(number, params.leaf_normals)
    leaf_first = np.concatenate([[0], np.cumsum(kept)])
    inside = np.arange(leaf_first[-1]) - np.repeat(leaf_first[:-1], kept)
    spread = inside * np.repeat(number, kept) // np.repeat(kept, kept)
    owner, *corner = np.unravel_index(boxes, (patches, *size))
    return {
        "box_edge": params.box,
        "patch_first": np.searchsorted(owner, np.arange(patches + 1)).astype(np.int32),
        "box": ((np.column_stack(corner) + low) * params.box).astype(np.float32),
        "leaf_first": leaf_first.astype(np.int32),
        "leaf_record": order[np.repeat(first, kept) + spread].astype(np.int32),
    }


_CLEARANCE = 5.0e-4  # [m] postures of the field keep this distance to the palm
_VECTOR_BYTES = 24  # at most, of one contact vector in all arrays
_LEAST_RECORDS = 60_000  # of a slot, when the records of a group are divided among settings
_PER_POSTURE = 4  # contact vectors drawn from one posture


def build_field(
    model: HandModel,
    params: FieldParams,
    progress: Callable[[str, float], None] | None = None,
    *,
    thumb: ThumbBend | None = None,
) -> ContactField:
    """Sample and index the contact field of a hand (Def. 4.2); groups without contact surface have no vectors.

    Args:
        progress: called with (what, share done).
        thumb: how the thumb stands in all postures.

    Raises:
        HandError: a group that no posture frees from the palm.
    """
    parts, groups = [], model.groups
    hand = upload_hand(model, "cpu", thumb)
    wp.load_module(contact_vectors.module.name, "cpu")  # once, not by every thread
    slots = model.surfaces * len(model.tree.settings) * groups
    for slot, part in in_order(partial(_sample_slot, hand, params), range(slots), cores()):
        parts.append(part)
        if progress:
            progress(f"group {slot + 1} of {slots}", (slot + 1) / slots)
    _check_clear(model, np.array([p["clear"] for p in parts]).reshape(-1, groups))
    cell = _bounded_cell([p["position"] for p in parts], params)
    origins, shapes, keys, base = [], [], [], 0
    for p in parts:
        origin = top = np.zeros(3, np.float32)
        if len(p["position"]):
            origin, top = p["position"].min(0) - 1e-4, p["position"].max(0)
        shape = np.floor((top - origin) / cell).astype(np.int64) + 1
        place = (p["position"] - origin) / cell
        index = np.minimum(place.astype(np.int64), shape - 1)
        voxel = base + (index[:, 0] * shape[1] + index[:, 1]) * shape[2] + index[:, 2]
        inside = np.clip((place - index) * 256, 0, 255).astype(np.int64)
        p["offset"] = inside[:, 0] << 16 | inside[:, 1] << 8 | inside[:, 2]
        keys.append(voxel * NORMAL_BINS + p["bin"])
        origins.append(origin)
        shapes.append(shape)
        base += int(shape.prod())
    key = np.concatenate(keys)
    order = np.argsort(key, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(key, minlength=base * NORMAL_BINS))])
    filled = (np.diff(start) > 0).reshape(base, NORMAL_BINS)
    mask = np.packbits(filled, axis=1, bitorder="little").view(np.uint64).ravel()
    if progress:
        progress("index", 1.0)

    def gather(name: str, dtype) -> np.ndarray:
        return np.concatenate([p[name] for p in parts])[order].astype(dtype)

    index = np.arange(*model.contact_first[groups : groups + 2])
    palm = {"position": model.contact_points[index], "direction": model.contact_normals[index]}
    palm["index"] = index
    position, point = gather("position", np.float32), gather("point", np.int32)
    setting = np.repeat(np.arange(slots) // groups, [len(p["point"]) for p in parts])[order]
    patch = setting * model.patches + model.contact_patch[point]
    indices: dict[str, Any] = box_index(position, patch, slots // groups * model.patches, params)
    indices |= opposed_pairs(parts, groups, palm, params.seed)
    return ContactField(
        hand_sha256=model.sha256,
        cell=cell,
        origin=np.array(origins, np.float32),
        shape=np.array(shapes, np.int32),
        cell_first=np.concatenate([[0], np.cumsum([s.prod() for s in shapes])]).astype(np.int32),
        start=start.astype(np.int32),
        mask=mask,
        point=point,
        offset=gather("offset", np.int32),
        normal=gather("normal", np.uint16),
        posture=gather("posture", np.uint8),
        clear_share=np.array([p["clear"] for p in parts], np.float32),
        **indices,
    )


def _bounded_cell(positions: list[np.ndarray], params: FieldParams) -> float:
    """The voxel edge [m], grown until table and vectors fit the memory bound."""
    vectors = sum(len(p) for p in positions) * _VECTOR_BYTES
    cell = params.cell
    while True:
        cells = sum(float(np.prod(np.floor(np.ptp(p, axis=0) / cell) + 2)) for p in positions if len(p))
        fits = cells * (4 * NORMAL_BINS + 8) + vectors <= params.max_mb * 1e6
        if fits and cells * NORMAL_BINS < 2**31:  # rows of the table are 32-bit
            return cell
        cell *= 1.25


def _check_clear(model: HandModel, clear: np.ndarray) -> None:
    """Raises HandError when a group is clear of the palm in no setting; ``clear`` (V, G) are shares of postures."""
    for group in np.flatnonzero((clear == 0.0).any(0) & ~(clear > 0.0).any(0)):
        links = np.array(model.tree.link_names)[model.tree.body_group[model.tree.link_body] == group]
        raise HandError(
            f"hand '{model.name}': no posture of finger ({', '.join(links)}) is clear of the palm and of itself"
        )


def _sample_slot(hand: HandArrays, params: FieldParams, slot: int) -> dict[str, np.ndarray]:
    """Contact vectors of a group in a setting; none when it has no contact surface, or no posture is clear."""
    model = hand.model
    settings = len(model.tree.settings)
    setting, group = divmod(slot, model.groups)
    # vectors may fill half of the memory bound, the table the rest
    room = int(0.5e6 * params.max_mb / _VECTOR_BYTES / (model.groups * settings * model.surfaces))
    records = params.records if settings == 1 else max(params.records // settings, min(params.records, _LEAST_RECORDS))
    run = model.contact_run(setting // settings, group)
    touches = model.contact_first[run + 1] > model.contact_first[run]
    postures = max(1000, int(1.5 * records / _PER_POSTURE)) if touches else 0
    posture = wp.zeros((postures, int(np.diff(model.tree.dof_first).max())), dtype=wp.uint8, device="cpu")
    clear = wp.empty(postures, dtype=wp.int32, device="cpu")
    seed = params.seed * 1009 + slot % (settings * model.groups)  # every surface meets the same postures
    inputs = [hand.struct, group, setting, seed, _CLEARANCE]
    wp.launch(sample_postures, postures, inputs, [posture, clear], device="cpu")
    good = np.flatnonzero(to_numpy(clear))
    count = min(records, room) if len(good) else 0
    chosen = np.resize(np.repeat(good, _PER_POSTURE), count).astype(np.int32)
    vectors = empty_struct(Vectors, "cpu", count)
    indices = wp.array(chosen, dtype=wp.int32, device="cpu")
    inputs = [hand.struct, group, setting, seed + 500_009, posture, indices]
    wp.launch(contact_vectors, count, inputs, [vectors], device="cpu")
    return {
        **{name: to_numpy(getattr(vectors, name)) for name in Vectors.vars},
        "posture": to_numpy(posture)[chosen],
        "clear": np.asarray(len(good) / postures if touches else np.nan, np.float32),
    }
