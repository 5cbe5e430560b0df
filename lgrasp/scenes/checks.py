"""Conditions on the values of a scene; used before writing and when checking."""

from collections.abc import Callable

import numpy as np

from lgrasp.dataset.checks import hand_problems, object_problems
from lgrasp.scenes.records import SceneRecord

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
