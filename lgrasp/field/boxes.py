"""The published index of a contact field (Alg. 1): per patch the occupied boxes, per box the contact vectors in it."""

from typing import Any

import numpy as np

from lgrasp.field.params import FieldParams


def box_index(position: np.ndarray, patch: np.ndarray, patches: int, params: FieldParams) -> dict[str, Any]:
    """Box arrays of a ContactField; empty ones when ``params.index`` is not ``bvh``.

    Args:
        position: contact vectors' positions [m], shape (N, 3).
        patch: their patches, shape (N,).
        patches: number of patches of the hand.
    """
    if params.index != "bvh":
        empty = np.zeros(0, np.int32)
        return {
            "box_edge": params.box,
            "patch_first": np.zeros(patches + 1, np.int32),
            "box": np.zeros((0, 3), np.float32),
            "leaf_first": np.zeros(1, np.int32),
            "leaf_record": empty,
        }
    place = np.floor(position / params.box).astype(np.int64)
    low = place.min(0)
    size = place.max(0) - low + 1
    key = ((patch * size[0] + place[:, 0] - low[0]) * size[1] + place[:, 1] - low[1]) * size[2] + place[:, 2] - low[2]
    order = np.argsort(key, kind="stable")
    boxes, first, number = np.unique(key[order], return_index=True, return_counts=True)
    # at most leaf_normals vectors a box, spread over those there are
    kept = np.minimum(number, params.leaf_normals)
    leaf_first = np.concatenate([[0], np.cumsum(kept)])
    inside = np.arange(leaf_first[-1]) - np.repeat(leaf_first[:-1], kept)
    spread = inside * np.repeat(number, kept) // np.repeat(kept, kept)
    corner = (
        np.column_stack([boxes // (size[1] * size[2]) % size[0], boxes // size[2] % size[1], boxes % size[2]]) + low
    )
    owner = boxes // (size[0] * size[1] * size[2])
    return {
        "box_edge": params.box,
        "patch_first": np.searchsorted(owner, np.arange(patches + 1)).astype(np.int32),
        "box": (corner * params.box).astype(np.float32),
        "leaf_first": leaf_first.astype(np.int32),
        "leaf_record": order[np.repeat(first, kept) + spread].astype(np.int32),
    }
