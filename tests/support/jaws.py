"""A gripper with two sliding jaws: around a cube a grasp whose forces are known, with a ball inputs of stages."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from support.urdfs import gripper

from lgrasp.field.arrays import upload_field
from lgrasp.field.build import build_field
from lgrasp.field.params import FieldParams
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord, Shard, ShardHeader
from lgrasp.hand.arrays import upload_hand
from lgrasp.hand.build import build_hand
from lgrasp.hand.find import find_hand
from lgrasp.hand.spec import Box, ContactRule, HandSpec
from lgrasp.hand.tree import Tree, build_tree
from lgrasp.hand.urdf import read_urdf
from lgrasp.object.arrays import upload_object
from lgrasp.object.params import ObjectParams
from lgrasp.object.preprocess import preprocess_object
from lgrasp.stages.context import Context

__all__ = ["EDGE", "HEIGHT", "RADIUS", "Jaws", "jaw_shard", "jaws_and_ball", "mesh_record", "shipped_hand"]

JOINTS, LINKS = ("l", "r"), ("base", "jaw_l", "jaw_r")
EDGE, HEIGHT = 0.04, 0.055  # of the cube, and of its centre above the base [m]
FACE = np.array([0.5 * EDGE, 0, 0])
RADIUS = 0.02  # of the ball [m]


def jaw_rows(press: float, opening: float = 0.01, count: int = 1) -> GraspRows:
    """The jaws' inner faces are at +-q: they touch the cube at q = half its edge, targets go ``press`` [m] beyond."""
    q = np.full((count, 2), EDGE / 2, "f4")
    points = np.stack([FACE, -FACE])
    normals = np.stack([[1, 0, 0], [-1, 0, 0]])
    return GraspRows(
        q=q,
        q_pregrasp=q + np.float32(opening),
        q_squeeze=q - np.float32(press),
        object_pose=np.tile(np.array([0, 0, HEIGHT, 1, 0, 0, 0], "f4"), (count, 1, 1)),
        object_index=np.zeros((count, 1), "i4"),
        contact_points=np.tile(points.astype("f4"), (count, 1, 1, 1)),
        contact_normals=np.tile(normals.astype("f4"), (count, 1, 1, 1)),
        contact_links=np.tile(np.array([1, 2], "i2"), (count, 1, 1)),
        contact_forces=np.tile(-0.5 * normals.astype("f4"), (count, 1, 1, 1)),
        candidate=np.arange(count, dtype="u8"),
    )


def mesh_record(name: str, mesh: trimesh.Trimesh) -> ObjectRecord:
    return ObjectRecord(
        id=name,
        name=name,
        scale=1.0,
        sha256="c" * 64,
        watertight=bool(mesh.is_watertight),
        vertices=np.asarray(mesh.vertices, "f4"),
        faces=np.asarray(mesh.faces, "i4"),
    )


def jaw_shard(folder: Path, rows: GraspRows, urdf: str | None = None) -> Shard:
    return Shard(
        header=ShardHeader(pipeline="swift", seed=0, shard_index=0, config={"run_key": "made up"}),
        hand=HandRecord(
            name="jaws",
            base_link="base",
            urdf=urdf or gripper(folder).read_text().replace('effort="1"', 'effort="100"'),
            joint_names=JOINTS,
            joint_lower=np.zeros(2, "f4"),
            joint_upper=np.full(2, 0.05, "f4"),
            link_names=LINKS,
            sha256="a" * 64,
        ),
        objects=[mesh_record("cube", trimesh.creation.box([EDGE] * 3))],
        grasps=rows,
    )


@dataclass(frozen=True)
class Jaws:
    """Makes shards of the gripper."""

    folder: Path

    def shard(self, press: float = 0.004, *, urdf: str | None = None, **more) -> Shard:
        return jaw_shard(self.folder, jaw_rows(press, **more), urdf)

    @staticmethod
    def rows(shard: Shard, **changes: np.ndarray) -> GraspRows:
        return replace(shard.grasps, **changes)


def jaws_and_ball(folder: Path, device: str) -> Context:
    """Two jaws that slide along x from where they meet, 0.05 m each at most, and a ball."""
    spec = HandSpec(
        name="jaws",
        contact=(ContactRule(links=("jaw_l", "jaw_r")),),
        canonical_box=Box(min=(-0.03, -0.01, 0.04), max=(0.03, 0.01, 0.08)),
        open_posture={"l": 0.04, "r": 0.04},
    )
    model = build_hand(gripper(folder), spec)
    obj = preprocess_object(trimesh.creation.icosphere(4, RADIUS), params=ObjectParams(contact_count=2048))
    hand = upload_hand(model, device)
    field = upload_field(build_field(model, FieldParams(records=2000)), model, device)
    return Context(hand, upload_object(obj, device), field, device, 0, 0)


def shipped_hand(name: str) -> tuple[HandRecord, Path, Tree]:
    """A shipped hand as a shard holds it, its URDF and its tree."""
    source = find_hand(name)
    urdf = read_urdf(source.urdf)
    tree = build_tree(urdf, source.spec)
    record = HandRecord(
        name=name,
        base_link=tree.base_link,
        urdf=urdf.text,
        joint_names=tree.listed_names,
        joint_lower=tree.listed_limits[:, 0],
        joint_upper=tree.listed_limits[:, 1],
        link_names=tree.link_names,
        sha256="b" * 64,
        meshes={mesh: file.read_bytes() for mesh, file in urdf.mesh_files.items()},
    )
    return record, source.urdf, tree
