"""The contents of a shard in memory: frozen records of NumPy arrays."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any, Self

import numpy as np

import lgrasp
from lgrasp.grasp.schema import GRASP_FIELDS, SEQUENCE_FIELDS


def now() -> str:
    """ISO 8601 with time zone."""
    return datetime.now(UTC).isoformat(timespec="seconds")


@dataclass(frozen=True, kw_only=True)
class HandRecord:
    """The hand; ``K`` actuated joints, ``L`` links."""

    name: str
    base_link: str
    """Link whose frame every pose is given in."""
    urdf: str
    """The URDF text."""
    joint_names: Sequence[str]
    """Actuated joints in the order of ``q``, length K."""
    joint_lower: np.ndarray
    """Lower limits [rad or m], shape [K], float32."""
    joint_upper: np.ndarray
    """Upper limits [rad or m], shape [K], float32."""
    link_names: Sequence[str]
    """Links that ``contact_links`` counts, length L."""
    sha256: str
    """Content hash of the hand, 64 hex digits."""
    meshes: Mapping[str, bytes] = field(default_factory=dict)
    """Mesh files by the path named in the URDF."""


@dataclass(frozen=True, kw_only=True)
class ObjectRecord:
    """One object as grasped."""

    id: str
    """Name of the object's group in the file; no ``/``."""
    name: str
    scale: float
    """Factor from the source mesh to ``vertices``."""
    sha256: str
    """SHA-256 of the source mesh, 64 hex digits."""
    watertight: bool
    vertices: np.ndarray
    """Vertex positions in the object's user frame [m], scale applied, shape [V, 3], float32."""
    faces: np.ndarray
    """Vertex indices of triangles, shape [F, 3], int32; none of a point cloud, whose points are the vertices."""
    normals: np.ndarray | None = None
    """Outward unit normals of the vertices, shape [V, 3], float32, where they are known, as of a point cloud."""
    tables: np.ndarray | None = None
    """Planes that it rests on: unit normal up, height along it [m], probability; user frame, shape [T, 5], float32."""
    regions: np.ndarray | None = None
    """Surface points in the object's user frame [m], and how much each belongs to the regions that grasps must touch
    and avoid, 0 to 1 (from 0.5 on it does), shape [S, 5], float32."""
    touch_share: float = 1.0
    """Least share of the normal force that contacts in the region to touch carry; 1: every contact is there."""


@dataclass(frozen=True, kw_only=True)
class SequenceRows:
    """How rows of a hand that takes objects one after another came about, step by step.

    Step s of a row grasps the object in slot s with one opposition space; joints that earlier steps moved stay where
    they are, and so do earlier objects in the hand.
    """

    space_names: Sequence[str]
    """Opposition spaces of the hand, the same for all rows of a file."""
    space: np.ndarray
    """Index in ``space_names`` of each step, shape [N, O], int16, -1 where absent."""
    free_joints: np.ndarray
    """Joints that the step moved, shape [N, O, K], bool, False where absent."""
    parent: np.ndarray
    """Row of the file that the row extends by one object, shape [N], int64, -1 for rows of one object."""
    q: np.ndarray
    """Joint positions at the grasp of each step [rad or m], shape [N, O, K], float32, NaN where absent."""
    q_pregrasp: np.ndarray
    """Joint positions before closing in each step [rad or m], shape [N, O, K], float32, NaN where absent."""
    q_squeeze: np.ndarray
    """Position targets that press in each step [rad or m], shape [N, O, K], float32, NaN where absent."""


CODE = "code: "
"""What the unit of a metric begins with whose numbers stand for names, which follow: ``0 none, 1 max_gap, ...``."""


@dataclass(frozen=True, kw_only=True)
class GraspRows:
    """``N`` grasps; ``K`` actuated joints, ``O`` objects in a row, ``C`` most contacts per object."""

    q: np.ndarray
    """Joint positions [rad or m], shape [N, K], float32."""
    q_pregrasp: np.ndarray
    """Joint positions before closing [rad or m], shape [N, K], float32."""
    q_squeeze: np.ndarray
    """Position targets that press on the object [rad or m], shape [N, K], float32."""
    object_pose: np.ndarray
    """Pose of the object's frame in the hand base frame, x y z [m] qw qx qy qz, shape [N, O, 7], NaN where absent."""
    object_index: np.ndarray
    """Position in the sorted object ids, shape [N, O], int32, -1 where absent."""
    contact_points: np.ndarray
    """Contact positions, object frame [m], shape [N, O, C, 3], float32, NaN padding."""
    contact_normals: np.ndarray
    """Outward unit normals of the object, object frame, shape [N, O, C, 3], float32, NaN padding."""
    contact_links: np.ndarray
    """Index in ``link_names``, shape [N, O, C], int16, -1 padding."""
    contact_forces: np.ndarray
    """Force of the hand on the object, object frame; normal parts sum to 1. Shape [N, O, C, 3], NaN padding."""
    candidate: np.ndarray
    """Global candidate index, shape [N], uint64."""
    metrics: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Numbers per grasp, each shape [N], float32; NaN = not measured."""
    metric_units: Mapping[str, str] = field(default_factory=dict)
    """Unit of each metric; absent = none."""
    physics: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Simulator verdicts, each shape [N, ...]."""
    physics_protocols: Mapping[str, str] = field(default_factory=dict)
    """Protocol of each verdict (one per name in ``physics``)."""
    table: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Of objects on a table: ``pose``, the place of its plane in ``tables`` of the object, shape [N], int32, and
    ``approach``, the unit direction in which the open hand comes, hand base frame, shape [N, 3], float32."""
    sequence: SequenceRows | None = None
    """Steps, where objects were taken one after another; then ``q...`` are those of the last step."""

    def __len__(self) -> int:
        return int(np.shape(self.q)[0])

    @property
    def valid(self) -> np.ndarray:
        """Rows that are grasps, shape [N], bool: all but those that were kept though they fail a bound."""
        valid = self.metrics.get("valid")
        return np.ones(len(self), bool) if valid is None else valid != 0

    @property
    def failed_bound(self) -> np.ndarray:
        """Name of the first bound that each row fails, as in ``GraspBounds``, shape [N], str; "none" of grasps."""
        codes = self.metrics.get("failed_bound")
        if codes is None:
            return np.where(self.valid, "none", "unknown")
        return np.array(self.failed_bounds)[codes.astype(int)]

    @property
    def failed_bounds(self) -> list[str]:
        """Names of the numbers in metric ``failed_bound``; none if the rows do not have it."""
        unit = self.metric_units.get("failed_bound", "") if "failed_bound" in self.metrics else ""
        return [entry.split(" ", 1)[1] for entry in unit.removeprefix(CODE).split(", ") if entry]

    def columns(self) -> dict[str, np.ndarray]:
        """Row arrays by flat name: fields, ``sequence/NAME``, ``table/NAME``, ``metrics/NAME``, ``physics/NAME``."""
        flat = {name: getattr(self, name) for name in GRASP_FIELDS}
        if self.sequence is not None:
            flat |= {name: getattr(self.sequence, name.removeprefix("sequence/")) for name in SEQUENCE_FIELDS}
        flat |= {f"table/{name}": values for name, values in self.table.items()}
        flat |= {f"metrics/{name}": values for name, values in self.metrics.items()}
        return flat | {f"physics/{name}": values for name, values in self.physics.items()}

    def select(self, rows: np.ndarray) -> Self:
        """Some rows of single objects, by number or mask; those of sequences extend other rows of their file."""
        changed: dict[str, Any] = {}
        for name, values in self.columns().items():
            group, slash, member = name.partition("/")
            place = changed.setdefault(group, {}) if slash else changed
            place[member if slash else name] = np.asarray(values)[rows]
        return replace(self, **changed)


@dataclass(frozen=True, kw_only=True)
class ShardHeader:
    """Where the rows come from: with the hand and objects, ``pipeline``, ``config``, ``seed`` regenerate them."""

    pipeline: str
    seed: int
    shard_index: int
    """Position in the run; -1 for a merged file."""
    config: Mapping[str, Any] = field(default_factory=dict)
    """Resolved pipeline parameters, JSON-serialisable."""
    created: str = field(default_factory=now)
    """ISO 8601 with time zone."""
    lgrasp_version: str = lgrasp.__version__
    merged_from: Sequence[Mapping[str, Any]] = ()
    """For a merged file: ``file``, ``shard_index`` and ``rows`` of each source."""


@dataclass(frozen=True, kw_only=True)
class Shard:
    """A whole shard in memory."""

    header: ShardHeader
    hand: HandRecord
    objects: Sequence[ObjectRecord]
    """At least one, sorted by ``id``."""
    grasps: GraspRows
    statistics: Mapping[str, int | float | str] = field(default_factory=dict)
    """Counts and seconds per stage, device name."""


def object_set_sha256(objects: Sequence[ObjectRecord]) -> str:
    """Hash of an object set: the object's own hash if single, else SHA-256 of the sorted hashes joined by newlines."""
    hashes = sorted(o.sha256 for o in objects)
    return hashes[0] if len(hashes) == 1 else hashlib.sha256("\n".join(hashes).encode()).hexdigest()


def padded(values: np.ndarray, tail: tuple[int, ...], fill: Any = None) -> np.ndarray:
    """Values [n, ...] with room at the end of each other axis, [n, *tail]; themselves if there is room enough.

    Args:
        fill: What is there; None: what means nothing: NaN, -1 or false.
    """
    if values.shape[1:] == tail:
        return values
    fill = {"f": np.nan, "i": -1}.get(values.dtype.kind, 0) if fill is None else fill
    out = np.full((len(values), *tail), fill, values.dtype)
    out[tuple(map(slice, values.shape))] = values
    return out
