"""The tables that flow between stages: structures of arrays on one device.

Tables made on a device are as long as they may get, and tell on the device how many of their rows are in use: no stage
waits for its number of rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
import warp as wp

from lgrasp.grasp.records import padded
from lgrasp.grasp.structs import Candidates, Poses, Sets
from lgrasp.runtime.fetch import fetch, to_numpy
from lgrasp.runtime.structs import empty_arrays, make_struct

CONTACTS = ("contact_points", "contact_normals", "contact_links", "contact_forces")
"""Columns of a table in memory that have room for C contacts."""
_FAMILIES = ("metrics", "physics", "table")  # columns that come by name


class DeviceTable:
    """Arrays on one device as the struct KIND describes them, and perhaps the table that they refer to."""

    KIND: ClassVar[Any]
    INNER: ClassVar[dict[str, type["DeviceTable"]]] = {}
    rows: wp.array  # (1,) i32 how many rows are in use: the first ones
    used: int | None = None  # the same where the host knows it (trim_sets): never of tables that a graph overwrites

    @cached_property
    def struct(self) -> Any:
        """The table as kernels read it."""
        return make_struct(self.KIND, self, **{n: getattr(self, n).struct for n in self.INNER if n in self.KIND.vars})

    def __len__(self) -> int:
        """Rows in use; waits for the device where they are not known."""
        return int(to_numpy(self.rows)[0]) if self.used is None else self.used

    @classmethod
    def names(cls) -> list[str]:
        """Columns, one row each."""
        return [name for name in cls.KIND.vars if name not in (*cls.INNER, "rows")]

    def taken(self, rows: np.ndarray) -> dict[str, wp.array]:
        """Columns of some rows, in the order given; copied on the device."""
        columns = {name: getattr(self, name) for name in self.names()}
        if len(rows) == 0:
            return {n: wp.empty((0, *a.shape[1:]), dtype=a.dtype, device=a.device) for n, a in columns.items()}
        chosen = wp.array(rows, dtype=wp.int32, device=next(iter(columns.values())).device)
        return {
            n: wp.indexedarray(a, [chosen] + [None] * (a.ndim - 1)).contiguous() if a.shape[0] else a
            for n, a in columns.items()
        }

    @classmethod
    def empty(cls, device: str, *shape: int, **given: Any) -> Self:
        """As many rows as there may be, none in use; columns have the first sizes of ``shape`` or are given."""
        if "rows" in cls.KIND.vars:
            given = {"rows": wp.zeros(1, dtype=wp.int32, device=device)} | given
        return cls(**empty_arrays(cls.KIND, device, *shape, **given))

    @classmethod
    def of(cls, arrays: dict[str, np.ndarray], device: str) -> Self:
        """Inverse of :meth:`arrays`."""
        kinds = {name: cls.KIND.vars[name].type.dtype for name in cls.names()}
        made: dict[str, Any] = {name: wp.array(arrays[name], dtype=kind, device=device) for name, kind in kinds.items()}
        for name, kind in cls.INNER.items():
            own = {key.removeprefix(f"{name}."): a for key, a in arrays.items() if key.startswith(f"{name}.")}
            made[name] = kind.of(own, device)
        if "rows" in cls.KIND.vars:
            made["rows"] = wp.full(1, len(arrays[cls.names()[0]]), dtype=wp.int32, device=device)
        return cls(**made)

    def arrays(self) -> dict[str, np.ndarray]:
        """The rows in use as NumPy arrays, those of the table that they refer to as ``TABLE.NAME``."""
        n = len(self)
        out = {name: to_numpy(getattr(self, name))[:n] for name in self.names()}
        for inner in self.INNER:
            out |= {f"{inner}.{name}": values for name, values in getattr(self, inner).arrays().items()}
        return out


@dataclass(frozen=True)
class PoseTable(DeviceTable):
    """Object poses in the hand base frame; P rows."""

    KIND = Poses
    index: wp.array
    pose: wp.array
    palm_point: wp.array
    palm_surface: wp.array
    setting: wp.array
    resting: wp.array
    anchor: wp.array
    rows: wp.array


@dataclass(frozen=True)
class CandidateTable(DeviceTable):
    """Up to M contacts that each of G groups can make at each of P poses, possibly realised."""

    KIND = Candidates
    INNER: ClassVar = {"poses": PoseTable}
    poses: PoseTable
    count: wp.array
    surface: wp.array
    record: wp.array
    state: wp.array
    q: wp.array
    further: wp.array

    def __len__(self) -> int:
        return len(self.poses)

    def arrays(self) -> dict[str, np.ndarray]:
        """As of every table; 0 in places beyond ``count``, which are never written."""
        out = super().arrays()
        used = np.arange(out["surface"].shape[2]) < out["count"][..., None]  # (P, G, M)
        if out["further"].size:
            out["further"] = np.where(used[..., None], out["further"], -1).astype(np.int32)
        same = {name: np.where(used, out[name], 0).astype(out[name].dtype) for name in ("surface", "record", "state")}
        return out | same | {"q": np.where(used[..., None], out["q"], 0).astype(out["q"].dtype)}


@dataclass(frozen=True)
class ContactSets(DeviceTable):
    """Sets of contacts that balance; S rows."""

    KIND = Sets
    INNER: ClassVar = {"candidates": CandidateTable}
    candidates: CandidateTable
    pose: wp.array
    slot: wp.array
    chosen: wp.array
    score: wp.array
    rows: wp.array


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
    table: dict[str, np.ndarray] = field(default_factory=dict)  # pose (N,) i32, approach (N, 3): where there is one

    def __len__(self) -> int:
        return len(self.index)


def trim_sets(table: ContactSets, used: int | None = None) -> ContactSets:
    """Views of the rows in use; waits for the device where ``used``, their number, is not given, and others may launch
    meanwhile."""
    if used is None and table.used is None:
        used = int(fetch([table.rows], others=True)[0][0])
    n = len(table) if used is None else used
    if n == table.pose.shape[0]:
        return table
    trimmed = replace(table, **{name: getattr(table, name)[:n] for name in table.names()})
    trimmed.__dict__["used"] = n
    return trimmed


def select_poses(table: CandidateTable, rows: np.ndarray, device: str) -> CandidateTable:
    """The candidates of some poses, in the order given; copied on the device."""
    poses = PoseTable(**table.poses.taken(rows), rows=wp.full(1, len(rows), dtype=wp.int32, device=device))
    return CandidateTable(poses, **table.taken(rows))


Rows = TypeVar("Rows")
"""A table in memory: a dataclass of arrays of N rows and of mappings of such, by the names of families."""


def grasp_arrays(table: Any) -> dict[str, np.ndarray]:
    """A table in memory as flat NumPy arrays (metrics as ``metrics.NAME``, and so on)."""
    out = {f.name: getattr(table, f.name) for f in fields(table) if f.name not in _FAMILIES}
    for family in _families(table):
        out |= {f"{family}.{name}": values for name, values in getattr(table, family).items()}
    return out


def _families(table: Any) -> list[str]:
    """Families of a table in memory, or of its class."""
    return [f.name for f in fields(table) if f.name in _FAMILIES]


def table_of(kind: type[Rows], arrays: dict[str, np.ndarray]) -> Rows:
    """Inverse of :func:`grasp_arrays`."""
    own: dict[str, Any] = {family: {} for family in _families(kind)}
    for name, values in arrays.items():
        family, dot, member = name.partition(".")
        if dot:
            own[family][member] = values
        else:
            own[name] = values
    return kind(**own)


def no_grasps() -> GraspTable:
    """A GraspTable before anything is known of its columns."""
    return table_of(GraspTable, {f.name: np.zeros(0) for f in fields(GraspTable) if f.name not in _FAMILIES})


def take_rows(table: Rows, rows: np.ndarray | slice) -> Rows:
    """Some rows of a table in memory, by index or mask (n,)."""
    if isinstance(rows, slice) or rows.dtype == bool:
        return table_of(type(table), {name: values[rows] for name, values in grasp_arrays(table).items()})
    # many times as fast as indexing
    return table_of(type(table), {name: values.take(rows, axis=0) for name, values in grasp_arrays(table).items()})


def take_grasps(table: GraspTable, rows: np.ndarray) -> GraspTable:
    """Some rows of a GraspTable, by rising index (n,): views when these are its first, else copies."""
    first = len(rows) and rows[-1] == len(rows) - 1
    return take_rows(table, slice(len(rows)) if first else rows)


def join_rows(tables: Sequence[Rows]) -> Rows:
    """Several tables in memory with the same columns, one after another."""
    if len(tables) == 1:
        return tables[0]
    parts = [grasp_arrays(t) for t in tables]
    return table_of(type(tables[0]), {name: np.concatenate([p[name] for p in parts]) for name in parts[0]})


def choose_grasps(old: GraspTable, new: GraspTable, into: np.ndarray, rows: np.ndarray) -> GraspTable:
    """``old`` with rows ``into`` (n,) taken from rows ``rows`` (n,) of ``new``; slots stay."""
    made = grasp_arrays(old)
    for name, values in grasp_arrays(new).items():
        if name != "slot":
            made[name] = made[name].copy()
            made[name][into] = values[rows]
    return table_of(GraspTable, made)


def widen_grasps(table: GraspTable, width: int) -> GraspTable:
    """The table with room for ``width`` contacts at least."""
    if table.contact_links.shape[1] >= width:
        return table
    out = grasp_arrays(table)
    out |= {name: padded(out[name], (width, *out[name].shape[2:])) for name in CONTACTS}
    return table_of(GraspTable, out)
