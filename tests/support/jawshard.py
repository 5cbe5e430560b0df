"""A shard written by hand: two prismatic jaws that squeeze a cube, and a plate."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import trimesh

# Two prismatic jaws over a palm, the right one a mesh; far behind, a thumb with a fixed tip drives a mimic lever.
URDF = """<robot name="jaws">
  <link name="palm"><collision><origin xyz="0 0 -0.02"/>
    <geometry><box size="0.1 0.12 0.02"/></geometry></collision></link>
  <link name="left"><collision><origin xyz="0 0 0.03"/>
    <geometry><box size="0.02 0.01 0.06"/></geometry></collision></link>
  <link name="right"><collision><origin xyz="0 0 0.03"/>
    <geometry><mesh filename="package://jaws/meshes/jaw.obj" scale="0.001 0.001 0.001"/></geometry></collision></link>
  <link name="thumb"><collision><origin xyz="-0.1 0 0.1"/>
    <geometry><cylinder radius="0.004" length="0.02"/></geometry></collision></link>
  <link name="tip"><collision><geometry><sphere radius="0.005"/></geometry></collision></link>
  <link name="lever"><collision><geometry><sphere radius="0.005"/></geometry></collision></link>
  <joint name="slide_left" type="prismatic"><parent link="palm"/><child link="left"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="0.06" effort="1" velocity="1"/></joint>
  <joint name="slide_right" type="prismatic"><parent link="palm"/><child link="right"/>
    <axis xyz="0 -1 0"/><limit lower="0" upper="0.06" effort="1" velocity="1"/></joint>
  <joint name="swing" type="revolute"><parent link="palm"/><child link="thumb"/>
    <origin xyz="-0.1 0 0" rpy="0.1 0.2 0.3"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="cap" type="fixed"><parent link="thumb"/><child link="tip"/><origin xyz="-0.1 0 0.13"/></joint>
  <joint name="follow" type="revolute"><parent link="tip"/><child link="lever"/><origin xyz="-0.05 0 0"/>
    <axis xyz="1 1 0"/><mimic joint="swing" multiplier="0.5" offset="0.01"/>
    <limit lower="-0.49" upper="0.46" effort="1" velocity="1"/></joint>
</robot>"""
LINKS = ["palm", "left", "right", "thumb", "tip", "lever"]
JAW = trimesh.creation.box((20.0, 10.0, 60.0))
CUBE = trimesh.creation.box((0.04, 0.04, 0.04))
PLATE = trimesh.creation.box((0.04, 0.08, 0.003))


def row(**changes: Any) -> dict[str, Any]:
    """A valid squeeze of the cube by two opposed contacts, with changes."""
    values: dict[str, Any] = {
        "q": [0.025, 0.025, 0.3],
        "follow": 0.16,
        "pose": [0, 0, 0.035, 1, 0, 0, 0],
        "object": 0,
        "points": [[0, 0.02, 0.001], [0, -0.02, 0.001]],
        "normals": [[0, 1, 0], [0, -1, 0]],
        "links": [1, 2],
        "forces": None,
    }
    assert set(changes) <= set(values)
    return values | changes


def write_shard(
    path: Path, rows: list[dict[str, Any]], metrics: dict[str, tuple[list[float], str]] | None = None
) -> Path:
    """Rows of the jaws as a shard, with metrics given as values and unit."""
    n, width = len(rows), 4
    path.parent.mkdir(exist_ok=True)
    points, normals, forces = (np.full((n, 1, width, 3), np.nan, "f4") for _ in range(3))
    links = np.full((n, 1, width), -1, "i2")
    for i, one in enumerate(rows):
        k = len(one["links"])
        points[i, 0, :k], normals[i, 0, :k], links[i, 0, :k] = one["points"], one["normals"], one["links"]
        forces[i, 0, :k] = -normals[i, 0, :k] / k if one["forces"] is None else one["forces"]
    with h5py.File(path, "w") as f:
        f.attrs["format"], f.attrs["format_version"], f.attrs["complete"] = "lgrasp-shard", "1.0", 1
        f.attrs["pipeline"], f.attrs["config"] = "by hand", '{"bounds": {"profile": "plan"}}'
        hand = f.create_group("hand")
        hand.attrs["base_link"] = "palm"
        hand["urdf"] = URDF
        hand["joint_names"] = ["slide_left", "slide_right", "swing", "follow"]
        hand["link_names"] = LINKS
        blob = JAW.export(file_type="obj").encode()
        hand["meshes/0"] = np.frombuffer(blob, np.uint8)
        hand["meshes/0"].attrs["path"] = "package://jaws/meshes/jaw.obj"
        for name, mesh in (("a_cube", CUBE), ("b_plate", PLATE)):
            group = f.create_group(f"objects/{name}")
            group.attrs["scale"] = 1.0
            group["vertices"], group["faces"] = mesh.vertices.astype("f4"), mesh.faces.astype("i4")
        g = f.create_group("grasps")
        g["q"] = np.array([[*r["q"], r["follow"]] for r in rows], "f4")
        g["object_pose"] = np.array([r["pose"] for r in rows], "f4")[:, None]
        g["object_index"] = np.array([r["object"] for r in rows], "i4")[:, None]
        g["contact_points"], g["contact_normals"], g["contact_links"] = points, normals, links
        g["contact_forces"] = forces
        for name, (values, unit) in (metrics or {}).items():
            g[f"metrics/{name}"] = np.array(values, "f4")
            g[f"metrics/{name}"].attrs["unit"] = unit
    return path
