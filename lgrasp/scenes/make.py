"""One scene from start to end: objects drawn, dropped, seen by cameras, grasps moved there and tested."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from lgrasp.geometry.poses import compose, device_from_stored, inverse, pose_matrix
from lgrasp.grasp.records import HandRecord, ObjectRecord
from lgrasp.hand.arrays import HandArrays, body_poses
from lgrasp.object.arrays import Object, ObjectArrays
from lgrasp.picture.camera import central_camera
from lgrasp.picture.depth import LabelledMesh, join_surfaces, render
from lgrasp.runtime.fetch import to_numpy
from lgrasp.scenes import collision_kernels as kernels
from lgrasp.scenes.drop import drop
from lgrasp.scenes.params import CameraParams, SceneParams
from lgrasp.scenes.records import CloudRecord, SceneGrasps, SceneRecord, ViewsRecord
from lgrasp.scenes.render import add_noise, draw_offsets, merge_views, place_cameras, table_surface
from lgrasp.scenes.schema import DEPTH_UNIT
from lgrasp.seeding import stage_seed
from lgrasp.simulate.solid import Solid


class Collisions(NamedTuple):
    """How deep the hand of n grasps sinks into the table and into other objects, at q_pregrasp and at q.

    Depths above the limit that was asked for may be given too small, but not below it.
    """

    table: np.ndarray
    """[m], shape (n, 2), f32, 0 when apart."""
    objects: np.ndarray
    """[m], shape (n, 2), f32, 0 when apart; the object that is grasped does not count."""


def hand_poses(scene_object: np.ndarray, hand_object: np.ndarray) -> np.ndarray:
    """T_scene_hand of grasps, x y z [m] qw qx qy qz with qw >= 0, shape (n, 7), f64, of T_scene_object, shape (7,), and
    the T_hand_object of each, as shards have it, shape (n, 7)."""
    return compose(np.broadcast_to(scene_object, hand_object.shape), inverse(hand_object))


def find_collisions(
    hand: HandArrays,
    objects: Sequence[ObjectArrays],
    object_pose: np.ndarray,
    own: int,
    hand_pose: np.ndarray,
    q_pregrasp: np.ndarray,
    q: np.ndarray,
    limit: float,
) -> Collisions:
    """The whole hand against the half space z < 0 and all objects but the one that is grasped, ``own``, by the exact
    tests of generation.

    Args:
        object_pose: T_scene_object of the objects' own frames, x y z [m] qw qx qy qz, shape (m, 7).
        hand_pose: T_scene_hand, shape (n, 7).
        q_pregrasp, q: actuated joints [rad or m], shape (n, K).
        limit: depth [m] that decides.
    """
    n, device = len(q), hand.device
    if not n:
        return Collisions(*np.zeros((2, 0, 2), np.float32))
    inward = inverse(object_pose)
    inward[:, :3] -= np.stack([o.model.center for o in objects])  # to the internal frames
    body = body_poses(hand, np.concatenate([q_pregrasp, q]))
    table, obstacle = (wp.zeros(2 * n, dtype=wp.float32, device=device) for _ in range(2))
    inputs = [
        hand.struct,
        wp.array([o.struct for o in objects], dtype=Object, device=device),
        own,
        wp.array(device_from_stored(inward), dtype=wp.transform, device=device),
        wp.array(device_from_stored(np.concatenate([hand_pose, hand_pose])), dtype=wp.transform, device=device),
        wp.array(body, dtype=wp.transform, device=device),
        limit,
    ]
    wp.launch(kernels.hand_depths, body.shape[:2], inputs, [table, obstacle], device=device)
    return Collisions(*(to_numpy(depth).reshape(2, n).T.copy() for depth in (table, obstacle)))


class Item(NamedTuple):
    """An object that may lie on the table, and its grasps by one hand."""

    record: ObjectRecord
    solid: Solid
    arrays: ObjectArrays
    T_hand_object: np.ndarray
    """x y z [m] qw qx qy qz of each grasp, shape (n, 7), as in a shard; so are the others."""
    q: np.ndarray
    q_pregrasp: np.ndarray
    q_squeeze: np.ndarray
    candidate: np.ndarray


def make_scene(
    hand: HandArrays,
    hand_record: HandRecord,
    items: Sequence[Item],
    params: SceneParams,
    seed: int,
    index: int,
    device: str = "cpu",
) -> SceneRecord:
    """Scene ``index`` of a run: a pure function of the arguments on one type of device.

    Raises:
        PhysicsError: MuJoCo is missing, or the objects never came to rest on the table.
    """

    def stream(what: str) -> np.random.Generator:
        return np.random.default_rng(stage_seed(seed, index, what))

    draw = stream("draw")  # no object comes again before all others have come
    rounds = [draw.permutation(len(items)) for _ in range(-(-params.objects // len(items)))]
    chosen = [items[i] for i in np.concatenate(rounds)[: params.objects]]
    settled = drop([item.solid for item in chosen], params.table, params.drop, stream("drop"))
    pose = settled.pose.astype(np.float32).astype(np.float64)  # as the file has it
    objects = sorted({item.record.id: item.record for item in chosen}.values(), key=lambda record: record.id)
    place = {record.id: at for at, record in enumerate(objects)}
    surfaces = [table_surface(params.table)]
    for label, (item, T) in enumerate(zip(chosen, pose_matrix(pose), strict=True), 1):
        vertices = np.asarray(item.record.vertices, float) @ T[:3, :3].T + T[:3, 3]
        surfaces.append(LabelledMesh(vertices, np.asarray(item.record.faces), np.full(len(item.record.faces), label)))
    views, cloud = _observe(join_surfaces(surfaces), params.camera, stream("cameras"), device)
    grasps, counts = _transfer(hand, chosen, pose, params, stream("grasps"))
    return SceneRecord(
        seed=seed,
        index=index,
        hand=hand_record,
        objects=objects,
        table=params.table,
        object_index=np.array([place[item.record.id] for item in chosen], np.int32),
        object_pose=pose.astype(np.float32),
        views=views,
        cloud=cloud,
        grasps=grasps,
        statistics=counts | {"drops": settled.tries, "seconds_simulated": settled.seconds},
    )


def _observe(
    surface: LabelledMesh, params: CameraParams, rng: np.random.Generator, device: str
) -> tuple[ViewsRecord, CloudRecord]:
    """Images of a surface by cameras around the table, and the cloud made from them."""
    camera = central_camera(params.width, params.height, params.angle)
    pose = place_cameras(params, rng).astype(np.float32)
    offsets = draw_offsets(params, rng).astype(np.float32)
    images = add_noise(render(surface, camera, pose, device), params, rng)
    views = ViewsRecord(
        intrinsics=camera,
        pose=pose,
        offset=offsets,
        depth=np.rint(images.depth / DEPTH_UNIT).astype(np.uint16),
        labels=images.labels.astype(np.int16),
    )
    return views, merge_views(images, offsets, params, device)


def _transfer(
    hand: HandArrays, chosen: Sequence[Item], pose: np.ndarray, params: SceneParams, rng: np.random.Generator
) -> tuple[SceneGrasps, dict[str, int]]:
    """Grasps of every object in the scene, how deep the hand sinks into what is around, and counts of those tested."""
    K, parts, limit = hand.model.dofs, [], np.float32(params.tolerance)
    counts = {"grasps_tested": 0, "grasps_free": 0, "grasps_into_table": 0, "grasps_into_objects": 0}
    for target, item in enumerate(chosen):
        rows = rng.permutation(len(item.q))[: params.tested]
        at = hand_poses(pose[target], item.T_hand_object[rows].astype(float)).astype(np.float32)
        q, before = item.q[rows], item.q_pregrasp[rows]
        arrays = [i.arrays for i in chosen]
        found = find_collisions(hand, arrays, pose, target, at, before[:, :K], q[:, :K], params.tolerance)
        table, objects = (found.table > limit).any(axis=1), (found.objects > limit).any(axis=1)
        free = np.logical_not(table | objects)
        for name, flags in zip(counts, (np.ones_like(free), free, table, objects), strict=True):
            counts[name] += int(flags.sum())
        kept = np.flatnonzero(free)[: params.grasps], np.flatnonzero(~free)[: params.colliding]
        kept = np.sort(np.concatenate(kept))
        parts.append(
            {
                "target": np.full(len(kept), target, np.int32),
                "hand_pose": at[kept],
                "q": q[kept],
                "q_pregrasp": before[kept],
                "q_squeeze": item.q_squeeze[rows[kept]],
                "table_depth": found.table[kept],
                "object_depth": found.objects[kept],
                "collision_free": free[kept],
                "candidate": item.candidate[rows[kept]],
            }
        )
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return SceneGrasps(**joined, tolerance=params.tolerance), counts
