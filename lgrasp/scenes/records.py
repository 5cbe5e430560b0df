"""The contents of a scene file in memory, frozen records of NumPy arrays, and the conditions on their values."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import lgrasp
from lgrasp.dataset.checks import hand_problems, object_problems
from lgrasp.grasp.records import HandRecord, ObjectRecord, now
from lgrasp.scenes.camera import Intrinsics


@dataclass(frozen=True, kw_only=True)
class ViewsRecord:
    """Images of ``V`` depth cameras, noise included."""

    intrinsics: Intrinsics
    pose: np.ndarray
    """T_scene_camera where the cameras truly were, x y z [m] qw qx qy qz, shape [V, 7], float32."""
    offset: np.ndarray
    """By how much the points of each view are displaced in the cloud [m], shape [V, 3], float32."""
    depth: np.ndarray
    """Along the optical axis in 0.1 mm, 0 where nothing is seen, shape [V, H, W], uint16."""
    labels: np.ndarray
    """-1 nothing, 0 table, k + 1 object k, shape [V, H, W], int16: the masks."""


@dataclass(frozen=True, kw_only=True)
class CloudRecord:
    """All views merged; ``P`` points in the scene frame."""

    points: np.ndarray
    """[m], shape [P, 3], float32."""
    normals: np.ndarray
    """Estimated from the depth image, unit, towards the camera, shape [P, 3], float32."""
    labels: np.ndarray
    """0 table, k + 1 object k, shape [P], int16."""
    view: np.ndarray
    """Camera that saw the point, shape [P], int16."""


@dataclass(frozen=True, kw_only=True)
class SceneGrasps:
    """``N`` grasps in a scene, ``K`` listed joints."""

    target: np.ndarray
    """Object that is grasped, 0 to M - 1, shape [N], int32."""
    hand_pose: np.ndarray
    """T_scene_base of the hand's base link, x y z [m] qw qx qy qz, shape [N, 7], float32."""
    q: np.ndarray
    """Joint positions [rad or m], shape [N, K], float32."""
    q_pregrasp: np.ndarray
    """Joint positions before closing [rad or m], shape [N, K], float32."""
    q_squeeze: np.ndarray
    """Position targets that press on the object [rad or m], shape [N, K], float32."""
    table_depth: np.ndarray
    """How deep the hand sinks into the table at q_pregrasp and q [m], shape [N, 2], float32."""
    object_depth: np.ndarray
    """The same for all other objects; above the tolerance perhaps too small [m], shape [N, 2], float32."""
    collision_free: np.ndarray
    """True if all four depths are within the tolerance, shape [N], bool."""
    candidate: np.ndarray
    """Global candidate index in the shard that the grasp comes from, shape [N], uint64."""
    tolerance: float
    """[m]"""

    def __len__(self) -> int:
        return len(self.q)


@dataclass(frozen=True, kw_only=True)
class SceneRecord:
    """One scene: ``M`` objects on a table, what cameras see of them, and grasps."""

    seed: int
    index: int
    """Number of the scene in its run."""
    hand: HandRecord
    objects: Sequence[ObjectRecord]
    """Those that lie on the table, each once, sorted by id."""
    table: float
    """Side of the table [m]; its top is z = 0 about the origin."""
    object_index: np.ndarray
    """Position of object k in ``objects``, shape [M], int32; one may lie there twice."""
    object_pose: np.ndarray
    """T_scene_object, x y z [m] qw qx qy qz, shape [M, 7], float32."""
    views: ViewsRecord
    cloud: CloudRecord
    grasps: SceneGrasps
    config: Mapping[str, Any] = field(default_factory=dict)
    """Parameters that decide the scene, JSON-serialisable."""
    statistics: Mapping[str, int | float | str] = field(default_factory=dict)
    created: str = field(default_factory=now)
    """ISO 8601 with time zone."""
    lgrasp_version: str = lgrasp.__version__


_UNIT = 1.0e-3  # of the lengths of quaternions and normals
_LIMIT = 1.0e-4  # [rad or m] outside the joint limits


def scene_problems(scene: SceneRecord) -> list[str]:
    """Problems of a scene, one line per kind."""
    problems = hand_problems(scene.hand)
    for record in scene.objects:
        problems += object_problems(record)

    def require(good: np.ndarray, text: str) -> None:
        bad = np.flatnonzero(~np.asarray(good).all(axis=tuple(range(1, np.ndim(good)))))
        if len(bad):
            problems.append(f"{text} (row {bad[0]}, {len(bad)} rows)")

    with np.errstate(invalid="ignore", over="ignore"):
        _check_layout(scene, require)
        _check_views(scene, require)
        _check_cloud(scene, require)
        _check_grasps(scene, require)
    if not 0.0 < scene.table < np.inf:
        problems.append(f"scene: table is {scene.table}, must be positive")
    if set(np.asarray(scene.object_index).tolist()) != set(range(len(scene.objects))):
        problems.append("scene/object_index: must name every object of the file, and no other")
    return problems


_Require = Callable[[np.ndarray, str], None]


def _check_poses(pose: np.ndarray, where: str, require: _Require) -> None:
    require(np.isfinite(pose), f"{where}: not finite")
    require(np.abs(np.linalg.norm(pose[:, 3:], axis=1) - 1.0) <= _UNIT, f"{where}: quaternion is not of unit length")
    require(pose[:, 3] >= 0.0, f"{where}: quaternion has w < 0")


def _check_layout(scene: SceneRecord, require: _Require) -> None:
    _check_poses(scene.object_pose, "scene/object_pose", require)


def _check_views(scene: SceneRecord, require: _Require) -> None:
    views, most = scene.views, len(scene.object_index)
    _check_poses(views.pose, "views/pose", require)
    require(np.isfinite(views.offset), "views/offset: not finite")
    require((views.labels >= -1) & (views.labels <= most), f"views/labels: must be -1 to {most}")
    require((views.labels == -1) == (views.depth == 0), "views/labels: -1 if and only if the depth is 0")


def _check_cloud(scene: SceneRecord, require: _Require) -> None:
    cloud, most = scene.cloud, len(scene.object_index)
    require(np.isfinite(cloud.points), "cloud/points: not finite")
    require(np.abs(np.linalg.norm(cloud.normals, axis=1) - 1.0) <= _UNIT, "cloud/normals: not of unit length")
    require((cloud.labels >= 0) & (cloud.labels <= most), f"cloud/labels: must be 0 to {most}")
    require((cloud.view >= 0) & (cloud.view < len(scene.views.pose)), "cloud/view: there is no such view")


def _check_grasps(scene: SceneRecord, require: _Require) -> None:
    grasps = scene.grasps
    require((grasps.target >= 0) & (grasps.target < len(scene.object_index)), "grasps/target: there is no such object")
    _check_poses(grasps.hand_pose, "grasps/hand_pose", require)
    lower, upper = np.asarray(scene.hand.joint_lower) - _LIMIT, np.asarray(scene.hand.joint_upper) + _LIMIT
    for name in ("q", "q_pregrasp", "q_squeeze"):
        require(np.isfinite(getattr(grasps, name)), f"grasps/{name}: not finite")
    require((grasps.q >= lower) & (grasps.q <= upper), "grasps/q: outside the joint limits by more than 1e-4")
    deepest = np.maximum(grasps.table_depth, grasps.object_depth)
    require((grasps.table_depth >= 0) & (grasps.object_depth >= 0), "grasps: a depth is negative or NaN")
    free = (deepest <= np.float32(grasps.tolerance)).all(axis=1)
    require(free == grasps.collision_free, "grasps/collision_free: does not follow from the depths and the tolerance")
