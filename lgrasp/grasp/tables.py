"""The tables that flow between stages: structures of arrays on one device."""

from dataclasses import dataclass

import numpy as np
import warp as wp

__all__ = ["CandidateTable", "ContactSets", "GraspTable", "PoseTable"]


@dataclass(frozen=True)
class PoseTable:
    """Object poses in the hand base frame; P rows."""

    index: wp.array  # (P,) i32 candidate index inside the shard's stream
    pose: wp.array  # (P,) transform T_hand_object of the object's internal frame
    palm_point: wp.array  # (P,) i32 hand contact point that touches, -1 without palm contact
    palm_surface: wp.array  # (P,) i32 object contact point that touches, -1

    def __len__(self) -> int:
        return self.index.shape[0]


@dataclass(frozen=True)
class CandidateTable:
    """Up to M contacts that each of G groups can make at each of P poses, possibly realised."""

    poses: PoseTable
    count: wp.array  # (P, G) i32 candidates drawn
    surface: wp.array  # (P, G, M) i32 object contact point
    record: wp.array  # (P, G, M) i32 contact vector of the field
    state: wp.array  # (P, G, M) i32: 0 = as drawn, 1 = realised, -1 = failed
    q: wp.array  # (P, G, M) vec_dof: joint seed, or the realised posture [rad or m]


@dataclass(frozen=True)
class ContactSets:
    """Sets of contacts that balance; S rows."""

    candidates: CandidateTable
    pose: wp.array  # (S,) i32 row of the PoseTable
    slot: wp.array  # (S,) i32 number of the set within its pose
    chosen: wp.array  # (S, G) i32 candidate of each group, -1 = unused
    score: wp.array  # (S,) f32 norm of the frictionless residual

    def __len__(self) -> int:
        return self.pose.shape[0]


@dataclass(frozen=True)
class GraspTable:
    """Finished grasps as NumPy arrays, N rows, in candidate order; C = groups + 1 contacts (palm last)."""

    index: np.ndarray  # (N,) i64 candidate index inside the stream
    slot: np.ndarray  # (N,) i32
    q: np.ndarray  # (N, K) f32
    q_pregrasp: np.ndarray  # (N, K)
    q_squeeze: np.ndarray  # (N, K)
    pose: np.ndarray  # (N, 7) f32 T_hand_object of the internal frame: x y z, qx qy qz qw
    contact_points: np.ndarray  # (N, C, 3) object's internal frame, NaN padding
    contact_normals: np.ndarray  # (N, C, 3) outward object normal
    contact_links: np.ndarray  # (N, C) i32 index in link_names, -1 padding
    contact_forces: np.ndarray  # (N, C, 3) object frame
    metrics: dict[str, np.ndarray]  # (N,) each
