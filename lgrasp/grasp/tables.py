"""The tables that flow between stages: structures of arrays on one device.

Tables made on a device are as long as they may get, and tell on the device how many of their rows are in use: no stage
waits for its number of rows.
"""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from lgrasp.grasp.structs import Candidates, Poses, Sets
from lgrasp.math.kinematics import MAX_DOFS, vec_dof
from lgrasp.runtime.structs import make_struct

_FAMILIES = ("metrics", "physics")  # columns of a GraspTable that come by name


@dataclass(frozen=True)
class PoseTable:
    """Object poses in the hand base frame; P rows."""

    index: wp.array  # (P,) i32 candidate index inside the shard's stream
    pose: wp.array  # (P,) transform T_hand_object of the object's internal frame
    palm_point: wp.array  # (P,) i32 hand contact point that touches, -1 without palm contact
    palm_surface: wp.array  # (P,) i32 object contact point that touches, -1
    setting: wp.array  # (P,) i32 setting of the hand's shared joints
    anchor: wp.array  # (P, G) i32 object contact point that each group can surely touch about, -1 unknown
    rows: wp.array  # (1,) i32 how many of the P rows are in use: the first ones

    @cached_property
    def struct(self) -> Any:
        """The table as kernels read it."""
        return make_struct(Poses, self)

    def __len__(self) -> int:
        """Rows in use; waits for the device."""
        return int(self.rows.numpy()[0])


@dataclass(frozen=True)
class CandidateTable:
    """Up to M contacts that each of G groups can make at each of P poses, possibly realised."""

    poses: PoseTable
    count: wp.array  # (P, G) i32 candidates drawn
    surface: wp.array  # (P, G, M) i32 object contact point
    record: wp.array  # (P, G, M) i32 contact vector of the field
    state: wp.array  # (P, G, M) i32 State
    q: wp.array  # (P, G, M) vec_dof: joint seed, or the realised posture [rad or m]

    @cached_property
    def struct(self) -> Any:
        """The table as kernels read it."""
        return make_struct(Candidates, self, poses=self.poses.struct)


@dataclass(frozen=True)
class ContactSets:
    """Sets of contacts that balance; S rows."""

    candidates: CandidateTable
    pose: wp.array  # (S,) i32 row of the PoseTable
    slot: wp.array  # (S,) i32 number of the set within its pose
    chosen: wp.array  # (S, G) i32 candidate of each group, -1 = unused
    score: wp.array  # (S,) f32 norm of the frictionless residual
    rows: wp.array  # (1,) i32 how many of the S rows are in use: the first ones

    @cached_property
    def struct(self) -> Any:
        """The table as kernels read it."""
        return make_struct(Sets, self)

    def __len__(self) -> int:
        """Rows in use; waits for the device."""
        return int(self.rows.numpy()[0])


@dataclass(frozen=True)
class GraspTable:
    """Finished grasps as NumPy arrays, N rows, in candidate order; C = groups + 1 contacts (palm last)."""

    index: np.ndarray  # (N,) i64 candidate index inside the stream
    slot: np.ndarray  # (N,) i32
    q: np.ndarray  # (N, K) f32
    q_pregrasp: np.ndarray  # (N, K)
    q_squeeze: np.ndarray  # (N, K)
    pose: np.ndarray  # (N, 7) f32 T_hand_object of the internal frame, device pose
    contact_points: np.ndarray  # (N, C, 3) object's internal frame, NaN padding
    contact_normals: np.ndarray  # (N, C, 3) outward object normal
    contact_links: np.ndarray  # (N, C) i32 index in link_names, -1 padding
    contact_forces: np.ndarray  # (N, C, 3) object frame
    metrics: dict[str, np.ndarray]  # (N,) each
    physics: dict[str, np.ndarray] = field(default_factory=dict)  # (N, ...) each: verdicts of a simulator

    def __len__(self) -> int:
        return len(self.index)


def pose_arrays(table: PoseTable) -> dict[str, np.ndarray]:
    """The rows in use of a PoseTable as NumPy arrays; ``pose`` holds device poses (P, 7)."""
    found = {f.name: getattr(table, f.name).numpy()[: len(table)] for f in fields(table) if f.name != "rows"}
    return found | {"pose": found["pose"].reshape(-1, 7)}


def pose_table(arrays: dict[str, np.ndarray], device: str) -> PoseTable:
    """Inverse of :func:`pose_arrays`."""
    dtypes = dict.fromkeys((f.name for f in fields(PoseTable) if f.name != "rows"), wp.int32) | {"pose": wp.transform}
    own = {name: wp.array(arrays[name], dtype=dtype, device=device) for name, dtype in dtypes.items()}
    return PoseTable(**own, rows=wp.full(1, len(arrays["index"]), dtype=wp.int32, device=device))


def candidate_arrays(table: CandidateTable) -> dict[str, np.ndarray]:
    """The rows in use of a CandidateTable as NumPy arrays; ``q`` is (P, G, M, MAX_DOFS)."""
    n = len(table.poses)
    own = {name: getattr(table, name).numpy()[:n] for name in ("count", "surface", "record", "state", "q")}
    return own | {f"poses.{name}": values for name, values in pose_arrays(table.poses).items()}


def candidate_table(arrays: dict[str, np.ndarray], device: str) -> CandidateTable:
    """Inverse of :func:`candidate_arrays`."""
    poses = {name.removeprefix("poses."): a for name, a in arrays.items() if name.startswith("poses.")}
    integers = {
        name: wp.array(arrays[name], dtype=wp.int32, device=device) for name in ("count", "surface", "record", "state")
    }
    q = wp.array(np.reshape(arrays["q"], (*arrays["surface"].shape, MAX_DOFS)), dtype=vec_dof, device=device)
    return CandidateTable(pose_table(poses, device), q=q, **integers)


def set_arrays(table: ContactSets) -> dict[str, np.ndarray]:
    """The rows in use of ContactSets as NumPy arrays."""
    n = len(table)
    own = {name: getattr(table, name).numpy()[:n] for name in ("pose", "slot", "chosen", "score")}
    return own | {f"candidates.{name}": values for name, values in candidate_arrays(table.candidates).items()}


def set_table(arrays: dict[str, np.ndarray], device: str) -> ContactSets:
    """Inverse of :func:`set_arrays`."""
    inner = {name.removeprefix("candidates."): a for name, a in arrays.items() if name.startswith("candidates.")}
    own = {name: wp.array(arrays[name], dtype=wp.int32, device=device) for name in ("pose", "slot", "chosen")}
    score = wp.array(arrays["score"], dtype=wp.float32, device=device)
    rows = wp.full(1, len(arrays["score"]), dtype=wp.int32, device=device)
    return ContactSets(candidates=candidate_table(inner, device), score=score, rows=rows, **own)


def trim_sets(table: ContactSets) -> ContactSets:
    """Views of the rows in use; waits for the device."""
    n = len(table)
    if n == table.pose.shape[0]:
        return table
    return replace(table, pose=table.pose[:n], slot=table.slot[:n], chosen=table.chosen[:n], score=table.score[:n])


def select_poses(table: CandidateTable, rows: np.ndarray, device: str) -> CandidateTable:
    """The candidates of some poses, in the order given; copied on the device."""
    chosen = wp.array(rows, dtype=wp.int32, device=device)

    def take(values: wp.array) -> wp.array:
        if len(rows) == 0:
            return wp.empty((0, *values.shape[1:]), dtype=values.dtype, device=device)
        return wp.indexedarray(values, [chosen] + [None] * (values.ndim - 1)).contiguous()

    poses = {f.name: take(getattr(table.poses, f.name)) for f in fields(PoseTable) if f.name != "rows"}
    own = {name: take(getattr(table, name)) for name in ("count", "surface", "record", "state", "q")}
    return CandidateTable(PoseTable(rows=wp.full(1, len(rows), dtype=wp.int32, device=device), **poses), **own)


def grasp_arrays(table: GraspTable) -> dict[str, np.ndarray]:
    """A GraspTable as flat NumPy arrays (metrics as ``metrics.NAME``, verdicts as ``physics.NAME``)."""
    out = {f.name: getattr(table, f.name) for f in fields(table) if f.name not in _FAMILIES}
    for family in _FAMILIES:
        out |= {f"{family}.{name}": values for name, values in getattr(table, family).items()}
    return out


def grasps_from_arrays(arrays: dict[str, np.ndarray]) -> GraspTable:
    """Inverse of :func:`grasp_arrays`."""
    own: dict[str, np.ndarray] = {}
    families: dict[str, dict[str, np.ndarray]] = {family: {} for family in _FAMILIES}
    for name, values in arrays.items():
        family, dot, member = name.partition(".")
        (families[family] if dot else own)[member or name] = values
    return GraspTable(**own, metrics=families["metrics"], physics=families["physics"])


def no_grasps() -> GraspTable:
    """A GraspTable before anything is known of its columns."""
    return grasps_from_arrays({f.name: np.zeros(0) for f in fields(GraspTable) if f.name not in _FAMILIES})


def take_grasps(table: GraspTable, rows: np.ndarray) -> GraspTable:
    """Some rows of a GraspTable, by rising index (n,): views when these are its first, else copies."""
    if len(rows) and rows[-1] == len(rows) - 1:
        return grasps_from_arrays({name: values[: len(rows)] for name, values in grasp_arrays(table).items()})
    return grasps_from_arrays({name: values[rows] for name, values in grasp_arrays(table).items()})


def choose_grasps(old: GraspTable, new: GraspTable, into: np.ndarray, rows: np.ndarray) -> GraspTable:
    """``old`` with rows ``into`` (n,) taken from rows ``rows`` (n,) of ``new``; slots stay."""
    made = grasp_arrays(old)
    for name, values in grasp_arrays(new).items():
        if name != "slot":
            made[name] = made[name].copy()
            made[name][into] = values[rows]
    return grasps_from_arrays(made)


def widen_grasps(table: GraspTable, width: int) -> GraspTable:
    """The table with room for ``width`` contacts at least."""
    missing = width - table.contact_links.shape[1]
    if missing <= 0:
        return table
    out = grasp_arrays(table)
    for name in ("contact_points", "contact_normals", "contact_links", "contact_forces"):
        x = out[name]
        none = -1 if name == "contact_links" else np.nan
        out[name] = np.pad(x, [(0, 0), (0, missing)] + [(0, 0)] * (x.ndim - 2), constant_values=none)
    return grasps_from_arrays(out)


def sort_grasps(table: GraspTable) -> GraspTable:
    """The rows in candidate order."""
    return reorder_grasps(table, np.argsort(table.index, kind="stable"))


def reorder_grasps(table: GraspTable, order: np.ndarray) -> GraspTable:
    """The rows in another order, (N,)."""
    return grasps_from_arrays({name: values[order] for name, values in grasp_arrays(table).items()})


def join_grasps(tables: list[GraspTable]) -> GraspTable:
    """Several GraspTables one after another."""
    if len(tables) == 1:
        return tables[0]
    parts = [grasp_arrays(t) for t in tables]
    return grasps_from_arrays({name: np.concatenate([p[name] for p in parts]) for name in parts[0]})
