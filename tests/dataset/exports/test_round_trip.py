"""What was exported is read back, and means the same to SciPy, yourdfpy and MuJoCo."""

import json
import shutil
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
import yourdfpy
from pxr import Usd, UsdGeom
from scipy.spatial.transform import Rotation
from support.places import TINY_SHARD

from lgrasp.dataset.exports.formats import FORMATS, export_shards, read_grasps
from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.dataset.exports.mjcf import Cut
from lgrasp.dataset.exports.plain_hand import plain_hand
from lgrasp.geometry.poses import pose_matrix
from lgrasp.object.mass import mass_properties

SINGLE = ["dexgraspnet", "dexgraspbench", "isaac-grasp", "graspgen", "usd", "webdataset"]
HANDS = ["schunk_svh", "shadow"]


def matrix(position, rotation: Rotation) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), position
    return T


def wxyz(q) -> Rotation:
    assert q[0] >= 0
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-7)
    return Rotation.from_quat(q, scalar_first=True)


def raw_dexgraspnet(out: Path, row: int):
    """T_object_link of the link that the format gives the pose of, that link, joints by name."""
    entry = np.load(out / "grasps" / "cup.npy", allow_pickle=True)[row]
    assert entry["scale"] == 1.0
    q = dict(entry["qpos"])
    angles = [q.pop(f"WRJR{axis}") for axis in "xyz"]
    position = [q.pop(f"WRJT{axis}") for axis in "xyz"]
    return matrix(position, Rotation.from_euler("xyz", angles)), "root_link", q


def raw_dexgraspbench(out: Path, row: int):
    entry = np.load(out / "grasps" / "cup" / f"{row:08d}.npy", allow_pickle=True).item()
    assert (out / entry["obj_path"]).is_file()
    assert entry["obj_scale"] == 1.0
    T_world_object = matrix(entry["obj_pose"][:3], wxyz(entry["obj_pose"][3:]))
    T_world_root = matrix(entry["grasp_qpos"][:3], wxyz(entry["grasp_qpos"][3:7]))
    q = dict(zip(entry["joint_names"], entry["grasp_qpos"][7:], strict=True))
    return np.linalg.inv(T_world_object) @ T_world_root, "root_link", q


def raw_isaac_grasp(out: Path, row: int):
    document = yaml.safe_load((out / "grasps" / "cup.yaml").read_text())
    assert (document["format"], document["format_version"]) == ("isaac_grasp", 1.0)
    entry = document["grasps"][f"grasp_{row}"]
    assert entry["confidence"] == 1.0
    turn = [entry["orientation"]["w"], *entry["orientation"]["xyz"]]
    assert document["gripper_frame_link"] == json.loads((out / "export.json").read_text())["hand"]["base_link"]
    return matrix(entry["position"], wxyz(turn)), "base_link", entry["cspace_position"]


def raw_graspgen(out: Path, row: int):
    document = json.loads((out / "grasps" / "cup.json").read_text())
    assert (out / "objects" / document["object"]["file"]).is_file()
    assert document["object"]["scale"] == 1.0
    grasps = document["grasps"]
    assert grasps["object_in_gripper"][row] is True
    joints = dict(zip(grasps["joint_names"], grasps["cspace_position"][row], strict=True))
    return np.array(grasps["transforms"][row]), "root_link", joints


def raw_usd(out: Path, row: int):
    stage = Usd.Stage.Open(str(out / "grasps" / "cup.usdc"))  # prims are gone with it
    hand = stage.GetPrimAtPath("/World/hand")
    assert hand.GetAttribute("lgrasp:holds").Get(row)
    joints = dict(
        zip(hand.GetAttribute("lgrasp:jointNames").Get(), hand.GetAttribute("lgrasp:grasp").Get(row), strict=True)
    )
    return np.array(hand.GetAttribute("lgrasp:root").Get(row)).T, "root_link", joints


def raw_webdataset(out: Path, row: int):
    with tarfile.open(out / "grasps" / "train-00000.tar") as tar:
        entry = json.load(tar.extractfile(f"{row:08d}.json"))
    assert (out / "objects" / f"{entry['object']}.obj").is_file()
    assert entry["holds"] is True
    names = json.loads((out / "export.json").read_text())["hand"]["joint_names"]
    pose = entry["hand_pose"]
    return matrix(pose[:3], wxyz(pose[3:])), "root_link", dict(zip(names, entry["q"], strict=True))


RAW = [raw_dexgraspnet, raw_dexgraspbench, raw_isaac_grasp, raw_graspgen, raw_usd, raw_webdataset]
RAW = dict(zip(SINGLE, RAW, strict=True))


def load(path: Path) -> yourdfpy.URDF:
    return yourdfpy.URDF.load(str(path), build_collision_scene_graph=False)


def posed(urdf: yourdfpy.URDF, q: dict[str, float]) -> yourdfpy.URDF:
    assert set(q) == set(urdf.actuated_joint_names)
    urdf.update_cfg(np.array([q[name] for name in urdf.actuated_joint_names]))
    return urdf


def assert_same(read, shard, form: str) -> None:
    order = [read.joint_names.index(name) for name in shard.hand.joint_names]
    for name in ("q", "q_pregrasp", "q_squeeze"):
        np.testing.assert_allclose(getattr(read.grasps, name)[:, order], getattr(shard.grasps, name), atol=1e-5)
    np.testing.assert_allclose(pose_matrix(read.grasps.object_pose), pose_matrix(shard.grasps.object_pose), atol=1e-5)
    assert (read.grasps.object_pose[..., 3] >= 0).all(), form


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("hand", HANDS)
def test_read_back(tmp_path, shards, hand, form):
    shard = shards.make(tmp_path / "a.h5", hand, n=3)
    done = export_shards(tmp_path / "a.h5", tmp_path / "out", form)
    assert done == (3, ("cup",))
    read = read_grasps(tmp_path / "out", form)
    assert read.joint_names == tuple(shard.hand.joint_names)
    assert_same(read, shard, form)
    assert [(o.code, o.scale) for o in read.objects] == [("cup", 1.0)]
    mesh = trimesh.load_mesh(read.objects[0].mesh, process=False)
    np.testing.assert_allclose(mesh.vertices, shard.objects[0].vertices, atol=1e-8)
    np.testing.assert_array_equal(mesh.faces, shard.objects[0].faces)
    turned = tuple(reversed(read.joint_names))
    assert_same(read_grasps(tmp_path / "out", form, joint_names=turned), shard, form)
    assert read_grasps(tmp_path / "out", form, joint_names=turned).joint_names == turned
    text = (tmp_path / "out" / "README.txt").read_text()
    words = ["metres, radians", "w first", "hand.urdf", "cup (3)", "a.h5"]
    assert all(word in text for word in (*words, *shard.hand.joint_names)), text
    if hand == "shadow":
        assert ("palm" if form == "isaac-grasp" else "world") in text
    if form in RAW:
        check_links(tmp_path, shard, form)


def test_points_of_a_stage(tmp_path, shards):
    """In each posture and row the points of every link in the world, by OpenUSD, are where yourdfpy has that link; the
    object's are those of the shard."""
    shard = shards.make(tmp_path / "a.h5", "shadow", n=3)
    export_shards(tmp_path / "a.h5", tmp_path / "out", "usd")
    (tmp_path / "hand.urdf").write_text(shard.hand.urdf)
    urdf = yourdfpy.URDF.load(str(tmp_path / "hand.urdf"), load_meshes=False)
    stage = Usd.Stage.Open(str(tmp_path / "out" / "grasps" / "cup.usdc"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 2)
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (1.0, "Z")
    variants = stage.GetPrimAtPath("/World/hand").GetVariantSet("posture")
    assert variants.GetVariantSelection() == "grasp"
    cup = UsdGeom.Mesh(stage.GetPrimAtPath("/World/cup"))
    np.testing.assert_array_equal(cup.GetPointsAttr().Get(), shard.objects[0].vertices)
    links = {name.replace(".", "_"): name for name in shard.hand.link_names}
    shown = list(stage.GetPrimAtPath("/World/hand").GetChildren())
    assert len(shown) > 10
    for posture, q in (("grasp", shard.grasps.q), ("pregrasp", shard.grasps.q_pregrasp)):
        variants.SetVariantSelection(posture)
        for row in range(3):
            pose, now = shard.grasps.object_pose[row, 0], UsdGeom.XformCache(row)
            T_base_object = matrix(pose[:3], Rotation.from_quat(pose[3:], scalar_first=True))
            posed(urdf, dict(zip(shard.hand.joint_names, q[row], strict=True)))
            for prim in shown:
                mesh = prim.GetChild("mesh")
                points = np.array(UsdGeom.Mesh(mesh).GetPointsAttr().Get(), float)
                points = np.append(points, np.ones((len(points), 1)), 1)
                T = np.linalg.inv(T_base_object) @ urdf.get_transform(links[prim.GetName()], shard.hand.base_link)
                got = points @ np.array(now.GetLocalToWorldTransform(mesh))
                np.testing.assert_allclose(got, points @ T.T, atol=1e-6)


def check_links(folder: Path, shard, form: str) -> None:
    """The raw files, posed by yourdfpy with the exported URDF, against the shard's URDF posed by the shard's rows."""
    index = json.loads((folder / "out" / "export.json").read_text())["hand"]
    (folder / "hand.urdf").write_text(shard.hand.urdf)
    theirs, ours = load(folder / "out" / "hand" / "hand.urdf"), load(folder / "hand.urdf")
    assert theirs.base_link == index["root_link"]
    for row, (q, pose) in enumerate(zip(shard.grasps.q, shard.grasps.object_pose[:, 0], strict=True)):
        T_object_hand, link, joints = RAW[form](folder / "out", row)
        T_base_object = matrix(pose[:3], Rotation.from_quat(pose[3:], scalar_first=True))
        posed(theirs, joints), posed(ours, dict(zip(shard.hand.joint_names, q, strict=True)))
        for name in shard.hand.link_names:
            got = T_object_hand @ theirs.get_transform(name, index[link])
            expected = np.linalg.inv(T_base_object) @ ours.get_transform(name, shard.hand.base_link)
            np.testing.assert_allclose(got, expected, atol=1e-5, err_msg=name)


@pytest.mark.parametrize("hand", HANDS)
def test_mujoco_opens_the_grasp(tmp_path, shards, hand):
    mujoco = pytest.importorskip("mujoco")
    shard = shards.make(tmp_path / "a.h5", hand, n=3)
    export_shards(tmp_path / "a.h5", tmp_path / "out", "mjcf")
    check_scenes(mujoco, tmp_path, shard)


def test_scenes_hold_their_grasps(tmp_path):
    """Ten grasps of the generator in MuJoCo: nothing overlaps at the grasp, squeezing keeps objects in the hand."""
    mujoco = pytest.importorskip("mujoco")
    export_shards(TINY_SHARD, tmp_path / "made", "mjcf")
    kept = 0
    for path in sorted((tmp_path / "made" / "grasps").iterdir()):
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, model.key("grasp").id)
        mujoco.mj_forward(model, data)
        assert min([0, *data.contact.dist[: data.ncon]]) > -2e-3
        mujoco.mj_resetDataKeyframe(model, data, model.key("squeeze").id)
        mujoco.mj_kinematics(model, data)
        start = data.body("object_0_tiny").xpos.copy()
        for _ in range(125):
            mujoco.mj_step(model, data)
        kept += np.linalg.norm(data.body("object_0_tiny").xpos - start) < 0.02
    assert kept >= 9


def test_scenes_collide_and_weigh_as_the_protocol(tmp_path, shards):
    """Links that their hulls would fill collide with the pieces given; the wrist stays, links do not sag."""
    mujoco = pytest.importorskip("mujoco")
    shard = shards.make(tmp_path / "a.h5", "shadow", n=1)
    boxes = [trimesh.creation.box((0.01, 0.01, 0.01)).apply_translation((x, 0, 0)).vertices for x in (0.0, 0.02)]
    cut = Cut(lambda _: [], lambda hand: {hand.base_link: boxes})
    export_shards(tmp_path / "a.h5", tmp_path / "out", "mjcf", cut=cut)
    assert [path.name for path in sorted((tmp_path / "out/hand/pieces").iterdir())] == ["piece_00.obj", "piece_01.obj"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out/grasps/00000000.xml"))
    palm = model.body(shard.hand.base_link)
    assert palm.geomnum[0] == 2
    heavy = [model.body(b).name for b in np.flatnonzero(model.body_gravcomp != 1)]
    assert [name.split("_")[0] for name in heavy] == ["world"] + ["object"] * (len(heavy) - 1)
    stiff = {model.actuator(i).name: model.actuator_gainprm[i, 0] for i in range(model.nu)}
    wrist = {name for name, kp in stiff.items() if kp == pytest.approx(5000)}
    assert {"WR" in name for name in wrist} == {True}
    assert {kp for name, kp in stiff.items() if name not in wrist} == {5.0}


@pytest.mark.parametrize(("suffix", "kind"), [("glb", "glb"), ("PLY", "ply"), ("stl", "stl_ascii"), ("STL", "stl")])
def test_mujoco_opens_meshes_of_other_formats(tmp_path, shards, suffix, kind):
    mujoco = pytest.importorskip("mujoco")
    part = trimesh.creation.box((0.01, 0.02, 0.03)).apply_translation((0.1, 0, 0)).export(file_type=kind)
    name, plain = f"package://arm/part.{suffix}", shards.hand("schunk_svh")
    urdf = plain.urdf.replace(
        "</link>",
        f'''<collision name="part"><geometry><mesh filename="{name}"/></geometry>
        </collision></link>''',
        1,
    )
    part = part.encode() if isinstance(part, str) else part
    shards.make(tmp_path / "a.h5", replace(plain, urdf=urdf, meshes={name: part, **plain.meshes}), n=1)
    export_shards(tmp_path / "a.h5", tmp_path / "out", "mjcf")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "grasps" / "00000000.xml"))
    (mesh,) = [k for k in range(model.nmesh) if model.mesh(k).name.startswith("part")]
    np.testing.assert_allclose(model.mesh_pos[mesh], (0.1, 0, 0), atol=1e-6)
    (file,) = (tmp_path / "out" / "hand" / "meshes").iterdir()
    np.testing.assert_allclose(trimesh.load_mesh(file).extents, (0.01, 0.02, 0.03), atol=1e-6)


def check_scenes(mujoco, folder: Path, shard) -> None:
    """Links against yourdfpy, objects against the shard, mimic joints and targets, in every scene."""
    shutil.move(folder / "out", folder / "elsewhere")
    ours = yourdfpy.URDF.load(str(folder / "elsewhere" / "hand" / "hand.urdf"))
    for row in range(len(shard.grasps)):
        model = mujoco.MjModel.from_xml_path(str(folder / "elsewhere" / "grasps" / f"{row:08d}.xml"))
        data = mujoco.MjData(model)
        for key, posture, targets in (
            ("grasp", "q", "q"),
            ("pregrasp", "q_pregrasp", "q_pregrasp"),
            ("squeeze", "q", "q_squeeze"),
        ):
            mujoco.mj_resetDataKeyframe(model, data, model.key(key).id)
            mujoco.mj_kinematics(model, data)
            q = dict(zip(shard.hand.joint_names, getattr(shard.grasps, posture)[row], strict=True))
            posed(ours, q)
            for name in shard.hand.link_names:
                if name != "world":
                    T = matrix(data.body(name).xpos, Rotation.from_quat(data.body(name).xquat, scalar_first=True))
                    np.testing.assert_allclose(T, ours.get_transform(name), atol=1e-5, err_msg=name)
            ctrl = {model.actuator(i).name: data.ctrl[i] for i in range(model.nu)}
            expected = dict(zip(shard.hand.joint_names, getattr(shard.grasps, targets)[row], strict=True))
            assert ctrl == pytest.approx(expected, abs=1e-6)
            base = ours.get_transform(shard.hand.base_link)
            present = np.flatnonzero(shard.grasps.object_index[row] >= 0)
            for place, column in enumerate(present):
                record = shard.objects[shard.grasps.object_index[row, column]]
                body = data.body(f"object_{place}_{record.id}")
                seen, weighed = model.body(body.id), mass_properties(record.vertices, record.faces)
                assert seen.mass == pytest.approx(0.1)
                np.testing.assert_allclose(seen.ipos, weighed.center, atol=1e-6)
                inertia = np.linalg.eigvalsh(weighed.inertia) * 0.1 / weighed.volume
                np.testing.assert_allclose(np.sort(seen.inertia), inertia, rtol=1e-4)
                T = matrix(body.xpos, Rotation.from_quat(body.xquat, scalar_first=True))
                np.testing.assert_allclose(T, base @ pose_matrix(shard.grasps.object_pose[row, column]), atol=1e-5)
        for joint in ours.robot.joints:
            if joint.mimic:
                source = data.joint(joint.mimic.joint).qpos[0]
                relation = joint.mimic.multiplier * source + (joint.mimic.offset or 0)
                assert data.joint(joint.name).qpos[0] == pytest.approx(relation, abs=1e-6)
        assert model.neq == sum(joint.mimic is not None for joint in ours.robot.joints)
        assert model.opt.gravity == pytest.approx([0, 0, 0])


def test_a_real_hand_can_be_used_alone(tmp_path, shards):
    """All meshes are in the folder: it is moved, and yourdfpy, trimesh and MuJoCo open it."""
    mujoco = pytest.importorskip("mujoco")
    shard = shards.make(tmp_path / "a.h5", shards.hand("barrett", real=True), n=2)
    export_shards(tmp_path / "a.h5", tmp_path / "out", "mjcf")
    assert_same(read_grasps(tmp_path / "out", "mjcf"), shard, "mjcf")
    check_scenes(mujoco, tmp_path, shard)
    urdf = yourdfpy.URDF.load(str(tmp_path / "elsewhere" / "hand" / "hand.urdf"), load_meshes=False)
    shapes = [shape for link in urdf.link_map.values() for shape in (*link.visuals, *link.collisions)]
    files = {shape.geometry.mesh.filename for shape in shapes if shape.geometry.mesh}
    assert {f"meshes/{path.name}" for path in (tmp_path / "elsewhere" / "hand" / "meshes").iterdir()} == files
    assert all(len(trimesh.load_mesh(tmp_path / "elsewhere" / "hand" / name).faces) for name in files)
    text = (tmp_path / "elsewhere" / "README.txt").read_text()
    assert all(
        f"{name} = " in text
        for name in json.loads((tmp_path / "elsewhere" / "export.json").read_text())["hand"]["mimic"]
    )


def test_the_hand_says_all_in_the_plainest_way(caplog, shards):
    """Joints that mimic such as mimic others, fixed ones that mimic, axes of any length, one number for three scales,
    corners that no face uses: not every program knows them."""
    joint = """<link name="{0}"/><joint name="{0}" type="{3}"><parent link="{1}"/><child link="{0}"/>{2}
        <axis xyz="0 0 3"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>"""
    chain = (
        ("b", "a", "", "prismatic"),
        ("c", "b", '<mimic joint="b" multiplier="2"/>', "prismatic"),
        ("d", "c", '<mimic joint="c" offset="0.1"/>', "prismatic"),
        ("e", "d", '<mimic joint="b"/>', "fixed"),
    )
    mesh = '<link name="a"><collision><geometry><mesh filename="m.obj" scale="0.1"/></geometry></collision></link>'
    urdf = f'<robot name="r">{mesh}{"".join(joint.format(*j) for j in chain)}</robot>'
    corners = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    hand = replace(
        shards.hand("barrett"),
        urdf=urdf,
        base_link="e",
        link_names=(*"abcde",),
        joint_names=("b",),
        meshes={"m.obj": corners + b"v 9 9 9\n"},
    )
    plain = plain_hand(hand)
    assert max(len(line.split()) for line in plain.meshes["m_2.obj"].splitlines()) == 4
    assert plain.meshes["m_2.obj"].count(b"\nv ") == 4
    assert 'scale="0.1 0.1 0.1"' in plain.urdf
    frames = HandFrames(plain.urdf, "e", ("b",), Path("a.h5"))
    assert frames.mimics == {"c": ("b", 2.0, 0.0), "d": ("b", 2.0, 0.1)}
    assert frames.all_joints(np.array([[0.1]]))["d"] == pytest.approx(0.3)
    np.testing.assert_allclose(frames.base_from_root(np.array([[0.1]]))[0, :3], [0, 0, -0.6], atol=1e-12)
    assert not caplog.records  # yourdfpy's


@pytest.mark.parametrize("form", ["dexgraspnet", "webdataset", "mjcf"])
def test_joints_go_by_name(tmp_path, shards, form):
    """A second shard of the same hand lists its joints in another order."""
    first = shards.make(tmp_path / "a.h5", "schunk_svh", n=2)
    hand = first.hand
    order = np.random.default_rng(5).permutation(len(hand.joint_names))
    mixed = replace(
        hand,
        joint_names=tuple(hand.joint_names[i] for i in order),
        joint_lower=hand.joint_lower[order],
        joint_upper=hand.joint_upper[order],
    )
    second = shards.make(tmp_path / "b.h5", mixed, n=3, seed=1)
    export_shards([tmp_path / "a.h5", tmp_path / "b.h5"], tmp_path / "out", form)
    read = read_grasps(tmp_path / "out", form)
    assert read.joint_names == tuple(hand.joint_names)
    np.testing.assert_allclose(read.grasps.q[2:][:, order], second.grasps.q, atol=1e-6)
    np.testing.assert_allclose(read.grasps.q[:2], first.grasps.q, atol=1e-6)
