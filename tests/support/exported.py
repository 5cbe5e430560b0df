"""Made-up shards of real kinematics: the shipped hands, and the real ones with their meshes where they are."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
import yourdfpy
from scipy.spatial.transform import Rotation
from support.places import ASSETS, ROOT

from lgrasp.dataset.writer import write_shard
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord, Shard, ShardHeader

REAL = {"schunk_svh": "schunk_svh/schunk_svh.urdf", "barrett": "barrett/barrett_mimic.urdf"}


@cache
def hand_record(name: str, real: bool = False) -> HandRecord:
    """A hand with limits and names by yourdfpy, meshes read from the disk."""
    path = ASSETS / "hands" / REAL[name] if real else ROOT / "hands" / name / "hand.urdf"
    if not path.is_file():
        pytest.skip(f"the real URDF is not at ../shared/assets/hands/{REAL[name]}")
    urdf = yourdfpy.URDF.load(str(path), load_meshes=False, build_collision_scene_graph=False)
    limits = np.array(
        [(urdf.joint_map[j].limit.lower, urdf.joint_map[j].limit.upper) for j in urdf.actuated_joint_names]
    )
    used = {c.geometry.mesh.filename for link in urdf.link_map.values() for c in link.collisions if c.geometry.mesh}
    return HandRecord(
        name=name,
        base_link=yaml.safe_load((ROOT / "hands" / name / "hand.yaml").read_text())["base_link"],
        urdf=path.read_text(),
        joint_names=tuple(urdf.actuated_joint_names),
        joint_lower=limits[:, 0].astype("f4"),
        joint_upper=limits[:, 1].astype("f4"),
        link_names=tuple(urdf.link_map),
        sha256="a" * 64,
        meshes={name: (path.parent / name).read_bytes() for name in sorted(used)},
    )


def object_record(name: str = "cup", digit: str = "1", scale: float = 0.05) -> ObjectRecord:
    mesh = trimesh.creation.box((0.04, 0.05, 0.06)).apply_translation([0.01, 0.02, 0.005])
    return ObjectRecord(
        id=name,
        name=name,
        scale=scale,
        sha256=digit * 64,
        watertight=True,
        vertices=mesh.vertices.astype("f4"),
        faces=mesh.faces.astype("i4"),
    )


def poses(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    turn = Rotation.random(int(np.prod(shape)), rng=rng).as_quat(scalar_first=True, canonical=True)
    return np.concatenate([rng.uniform(-0.3, 0.3, (*shape, 3)), turn.reshape(*shape, 4)], -1).astype("f4")


def rows(hand: HandRecord, pose: np.ndarray, index: np.ndarray, rng: np.random.Generator) -> GraspRows:
    """Random joints within their limits, no contacts."""
    n, width = index.shape
    q = rng.uniform(hand.joint_lower, hand.joint_upper, (3, n, len(hand.joint_names))).astype("f4")
    q = np.clip(q, hand.joint_lower, hand.joint_upper)
    nothing = np.zeros((n, width, 0, 3), "f4")
    return GraspRows(
        q=q[0],
        q_pregrasp=q[1],
        q_squeeze=q[2],
        object_pose=np.where(index[..., None] < 0, np.float32(np.nan), pose),
        object_index=index.astype("i4"),
        contact_points=nothing,
        contact_normals=nothing,
        contact_links=np.zeros((n, width, 0), "i2"),
        contact_forces=nothing,
        candidate=np.arange(n, dtype="u8"),
        metrics={"epsilon": np.linspace(0, 1, n).astype("f4")},
    )


def make_shard(
    path: Path,
    hand: HandRecord | str = "allegro",
    n: int = 6,
    *,
    objects: Sequence[ObjectRecord] | None = None,
    index: np.ndarray | None = None,
    seed: int = 0,
    holds: np.ndarray | None = None,
) -> Shard:
    """Write a shard and give it back; by default every row holds the first of the objects."""
    hand = hand_record(hand) if isinstance(hand, str) else hand
    rng = np.random.default_rng(seed)
    index = np.zeros((n, 1), int) if index is None else index
    grasps = rows(hand, poses(rng, index.shape), index, rng)
    if hand.name == "shadow":  # the wrist is locked: it is between the root and the base link
        still = [hand.joint_names.index(name) for name in ("WRJ2", "WRJ1")]
        for q in (grasps.q, grasps.q_pregrasp, grasps.q_squeeze):
            q[:, still] = 0.1, -0.2
    if holds is not None:
        grasps = replace(grasps, physics={"fc_holds": holds}, physics_protocols={"fc_holds": "{}"})
    shard = Shard(
        header=ShardHeader(pipeline="swift", seed=0, shard_index=seed),
        hand=hand,
        objects=objects or [object_record()],
        grasps=grasps,
    )
    write_shard(path, shard)
    return shard
