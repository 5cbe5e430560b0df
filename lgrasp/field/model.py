"""ContactField: every contact vector a hand was seen to make, with the posture that makes it, indexed by voxel."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

FIELD_VERSION = 7
"""Raised whenever the arrays of a ContactField change meaning."""


@dataclass(frozen=True)
class ContactField:
    """Contact vectors of S slots, sorted by (slot, voxel, normal bin).

    Slot ``setting * groups + group`` holds those of a group with the shared joints at one of their settings; of a hand
    with several contact surfaces all settings come for each of them. The vectors of voxel v (counted over all slots)
    and normal bin b are rows ``start[v * 64 + b]`` to the next entry.
    """

    hand_sha256: str
    cell: float  # voxel edge [m]
    origin: np.ndarray  # (S, 3) f32 lowest corner of each slot's grid [m]
    shape: np.ndarray  # (S, 3) i32
    cell_first: np.ndarray  # (S + 1,) i32
    start: np.ndarray  # (cells * 64 + 1,) i32
    mask: np.ndarray  # (cells,) u64: bit b is set when normal bin b holds a vector
    point: np.ndarray  # (N,) i32 contact point of the hand
    offset: np.ndarray  # (N,) i32 place inside the voxel, 3 x 8 bits
    normal: np.ndarray  # (N,) u16 octahedral hand normal
    posture: np.ndarray  # (N, D) u8 joint seed, share of each joint's range
    clear_share: np.ndarray  # (S,) share of uniform postures clear of the palm, NaN for groups without contact surface
    # contact vectors of two fingers, or of the only one with contact surface and the palm, that press towards each
    # other, by distance
    pair_point: np.ndarray  # (P, 2, 3) f32 [m]
    pair_normal: np.ndarray  # (P, 2, 3) f32 hand normals
    pair_slot: np.ndarray  # (P, 2) i32
    pair_width: np.ndarray  # (P,) f32 rising [m]
    # the published index, empty unless asked for: per setting and patch the occupied boxes, per box
    # the vectors in it
    box_edge: float  # [m]
    patch_first: np.ndarray  # (settings * patches + 1,) i32 boxes of each patch
    box: np.ndarray  # (boxes, 3) f32 lowest corner [m]
    leaf_first: np.ndarray  # (boxes + 1,) i32
    leaf_record: np.ndarray  # (leaves,) i32 rows of the vectors

    @property
    def vectors(self) -> int:
        return len(self.point)

    @property
    def megabytes(self) -> float:
        return sum(a.nbytes for a in self.to_arrays().values()) / 1e6

    def to_arrays(self) -> dict[str, np.ndarray]:
        return {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> "ContactField":
        values: dict[str, Any] = {f.name: arrays[f.name] for f in fields(cls)}
        values |= {name: float(values[name]) for name in ("cell", "box_edge")}
        values["hand_sha256"] = str(values["hand_sha256"])
        return cls(**values)
