"""The contents of a scene file in memory, frozen records of NumPy arrays, and the conditions on their values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import lgrasp
from lgrasp.dataset.checks import accepted_limits, are_unit, hand_problems, object_problems, requirer
from lgrasp.grasp.records import HandRecord, ObjectRecord, now
from lgrasp.grasp.schema import POSTURES
from lgrasp.picture.camera import Intrinsics


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


def scene_problems(scene: SceneRecord) -> list[str]:
    """Problems of a scene, one line per kind."""
    problems = [*hand_problems(scene.hand), *(line for record in scene.objects for line in object_problems(record))]
    require, most = requirer(problems), len(scene.object_index)

    def require_poses(pose: np.ndarray, where: str) -> None:
        require(np.isfinite(pose), f"{where}: not finite")
        require(are_unit(pose[:, 3:]), f"{where}: quaternion is not of unit length")
        require(pose[:, 3] >= 0.0, f"{where}: quaternion has w < 0")

    views, cloud, grasps = scene.views, scene.cloud, scene.grasps
    with np.errstate(invalid="ignore", over="ignore"):
        require_poses(scene.object_pose, "scene/object_pose")
        require_poses(views.pose, "views/pose")
        require(np.isfinite(views.offset), "views/offset: not finite")
        require((views.labels >= -1) & (views.labels <= most), f"views/labels: must be -1 to {most}")
        require((views.labels == -1) == (views.depth == 0), "views/labels: -1 if and only if the depth is 0")
        require(np.isfinite(cloud.points), "cloud/points: not finite")
        require(are_unit(cloud.normals), "cloud/normals: not of unit length")
        require((cloud.labels >= 0) & (cloud.labels <= most), f"cloud/labels: must be 0 to {most}")
        require((cloud.view >= 0) & (cloud.view < len(views.pose)), "cloud/view: there is no such view")
        require((grasps.target >= 0) & (grasps.target < most), "grasps/target: there is no such object")
        require_poses(grasps.hand_pose, "grasps/hand_pose")
        for name in POSTURES:
            require(np.isfinite(getattr(grasps, name)), f"grasps/{name}: not finite")
        lower, upper = accepted_limits(scene.hand)
        require((grasps.q >= lower) & (grasps.q <= upper), "grasps/q: outside the joint limits by more than 1e-4")
        depths = np.stack([grasps.table_depth, grasps.object_depth])
        require((depths >= 0).all(0), "grasps: a depth is negative or NaN")
        free = (depths.max(0) <= np.float32(grasps.tolerance)).all(axis=1) == grasps.collision_free
        require(free, "grasps/collision_free: does not follow from the depths and the tolerance")
    if not 0.0 < scene.table < np.inf:
        problems.append(f"scene: table is {scene.table}, must be positive")
    if set(np.asarray(scene.object_index).tolist()) != set(range(len(scene.objects))):
        problems.append("scene/object_index: must name every object of the file, and no other")
    return problems
