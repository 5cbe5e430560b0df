"""Two grippers on one base, each around a cube, or one around both: a hand of two objects whose forces are known."""

from dataclasses import replace

import numpy as np
import trimesh
from support.jaws import EDGE, HEIGHT, mesh_record

from lgrasp.grasp.records import GraspRows, HandRecord, Shard, ShardHeader

__all__ = ["SIDE", "in_one_gripper", "twin_rows", "twin_shard"]

SIDE = 0.06
"""Of the grippers from the middle of the base along y [m]; gripper a at -SIDE, b at +SIDE."""

JAW = (
    '<link name="{n}"><collision><origin xyz="{x} 0 0.03"/><geometry><box size="0.01 0.02 0.06"/></geometry>'
    '</collision></link><joint name="{n}" type="prismatic"><parent link="base"/><child link="{n}"/>'
    '<origin xyz="0 {y} 0.035"/><axis xyz="{s} 0 0"/><limit lower="0" upper="0.06" effort="100" velocity="1"/></joint>'
)
BASE = '<link name="base"><collision><geometry><box size="0.12 0.2 0.06"/></geometry></collision></link>'
NAMES = ("al", "ar", "bl", "br")


def twin_urdf() -> str:
    jaws = [
        JAW.format(n=gripper + side, x=0.005 * s, y=y, s=s)
        for gripper, y in (("a", -SIDE), ("b", SIDE))
        for side, s in (("l", 1), ("r", -1))
    ]
    return f'<robot name="twins">{BASE}{"".join(jaws)}</robot>'


def twin_rows(press: float = 0.004, count: int = 1) -> GraspRows:
    """Gripper a around object 0, b around object 1: jaws touch the cubes at q, targets go ``press`` [m] beyond."""
    q = np.full((count, 4), EDGE / 2, "f4")
    pose = np.tile(np.array([0, 0, HEIGHT, 1, 0, 0, 0], "f4"), (count, 2, 1))
    pose[:, :, 1] = -SIDE, SIDE
    normals = np.array([[1, 0, 0], [-1, 0, 0]], "f4")
    points, forces = (np.tile(f * normals, (count, 2, 1, 1)).astype("f4") for f in (EDGE / 2, -0.5))
    return GraspRows(
        q=q,
        q_pregrasp=q + np.float32(0.01),
        q_squeeze=q - np.float32(press),
        object_pose=pose,
        object_index=np.tile(np.array([0, 1], "i4"), (count, 1)),
        contact_points=points,
        contact_normals=np.tile(normals, (count, 2, 1, 1)),
        contact_links=np.tile(np.array([[1, 2], [3, 4]], "i2"), (count, 1, 1)),
        contact_forces=forces,
        candidate=np.arange(count, dtype="u8"),
    )


def in_one_gripper(press: float) -> GraspRows:
    """Both cubes side by side in gripper a, which reaches object 0 with one jaw and object 1 with the other."""
    rows = twin_rows(press)
    q, pose, links = rows.q.copy(), rows.object_pose.copy(), np.full((1, 2, 2), -1, "i2")
    q[:, :2] = EDGE
    pose[..., 0], pose[..., 1] = (EDGE / 2, -EDGE / 2), -SIDE
    links[:, 0, 0], links[:, 1, 1] = 1, 2
    nan = np.where(links[..., None] >= 0, np.float32(0), np.float32(np.nan))
    return replace(
        rows,
        q=q,
        q_pregrasp=q + np.float32(0.01),
        q_squeeze=q - np.float32(press),
        object_pose=pose,
        contact_links=links,
        **{name: getattr(rows, name) + nan for name in ("contact_points", "contact_normals", "contact_forces")},
    )


def twin_shard(rows: GraspRows, heights: tuple[float, float] = (EDGE, EDGE)) -> Shard:
    """A shard of the hand and cubes "one" and "two", whose edges along y may differ [m]."""
    boxes = [trimesh.creation.box([EDGE, height, EDGE]) for height in heights]
    return Shard(
        header=ShardHeader(pipeline="swift", seed=0, shard_index=0, config={"run_key": "made up"}),
        hand=HandRecord(
            name="twins",
            base_link="base",
            urdf=twin_urdf(),
            joint_names=NAMES,
            joint_lower=np.zeros(4, "f4"),
            joint_upper=np.full(4, 0.06, "f4"),
            link_names=("base", *NAMES),
            sha256="a" * 64,
        ),
        objects=[mesh_record(name, box) for name, box in zip(("one", "two"), boxes, strict=True)],
        grasps=rows,
    )
