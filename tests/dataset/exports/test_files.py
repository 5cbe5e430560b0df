"""The files themselves: readable by other programs, by others' programs written, damaged, hostile."""

import os
import pickle
import pickletools
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from lgrasp.dataset.exports.dexgraspbench import read_dexgraspbench
from lgrasp.dataset.exports.dexgraspnet import read_dexgraspnet
from lgrasp.dataset.exports.formats import FORMATS, export_shards, read_grasps
from lgrasp.dataset.exports.isaac_grasp import read_isaac_grasp
from lgrasp.dataset.exports.mjcf import read_mjcf
from lgrasp.dataset.exports.npy import load_objects, save_object, save_objects
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import ConfigError, ShardError
from lgrasp.grasp.records import GraspRows, Shard, ShardHeader


def names(path) -> set[str]:
    """What a pickle would import."""
    data = path.read_bytes()
    start = data.index(b"\n", 10) + 1
    return {str(arg) for op, arg, _ in pickletools.genops(data[start:]) if op.name == "GLOBAL"}


def test_pickles_are_those_of_every_numpy(tmp_path):
    """NumPy before 1.26 has no numpy._core."""
    save_object(tmp_path / "one.npy", {"a": np.arange(3.0), "b": "text", "c": 1.5})
    save_objects(tmp_path / "many.npy", 3000, ({"a": float(i)} for i in range(3000)))
    save_objects(tmp_path / "none.npy", 0, [])
    for path in tmp_path.iterdir():
        assert names(path) == {"numpy.core.multiarray _reconstruct", "numpy ndarray", "numpy dtype"}
    one = np.load(tmp_path / "one.npy", allow_pickle=True)
    assert one.shape == ()
    np.testing.assert_array_equal(one.item().pop("a"), [0, 1, 2])
    many = np.load(tmp_path / "many.npy", allow_pickle=True)
    assert many.shape == (3000,)
    assert many.tolist() == [{"a": float(i)} for i in range(3000)] == load_objects(tmp_path / "many.npy")
    assert (
        np.load(tmp_path / "none.npy", allow_pickle=True).shape == (0,) == np.shape(load_objects(tmp_path / "none.npy"))
    )


@pytest.mark.parametrize("protocol", range(2, 6))
def test_what_numpy_wrote_is_read(tmp_path, protocol):
    value = [{"a": np.float32(1.5), "b": np.arange(4), "c": "text", "d": [1, (2.0, None)]}]
    array = np.empty(1, object)
    array[:] = value
    with open(tmp_path / "a.npy", "wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": (1,)})
        pickle.dump(array, file, protocol=protocol)
    (read,) = load_objects(tmp_path / "a.npy")
    np.testing.assert_array_equal(read.pop("b"), np.arange(4))
    assert read == {"a": 1.5, "c": "text", "d": [1, (2.0, None)]}


class Evil:
    path = Path()

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_nothing_in_a_file_is_run(tmp_path):
    evil = Evil()
    Evil.path = tmp_path / "gotcha"
    np.save(tmp_path / "a.npy", np.array([{"qpos": evil}], object))
    for read in (read_dexgraspnet, read_dexgraspbench):
        with pytest.raises(ShardError, match=r"a\.npy: not a \.npy file of grasps: it would call posix\.mkdir"):
            read(tmp_path / "a.npy")
    assert not (tmp_path / "gotcha").exists()


def test_others_dexgraspnet(tmp_path):
    """As its authors publish it: no export.json, other joint names, another scale, the grasp only."""
    rng = np.random.default_rng(0)
    joints, wrist = ("robot0:FFJ3", "robot0:THJ0"), ("WRJTx", "WRJTy", "WRJTz", "WRJRx", "WRJRy", "WRJRz")
    values = rng.uniform(-1, 1, (3, 8))
    entries = [
        {"qpos": dict(zip((*joints, *wrist), map(float, (*row[6:], *row[:6])), strict=True)), "scale": 0.08, "v": 1}
        for row in values
    ]
    np.save(tmp_path / "core-mug-1.npy", np.array(entries, object))
    read = read_dexgraspnet(tmp_path, joint_names=joints[::-1])
    assert read.joint_names == joints[::-1]
    assert [(o.code, o.scale, o.mesh) for o in read.objects] == [("core-mug-1", 0.08, None)]
    np.testing.assert_allclose(read.grasps.q, values[:, [7, 6]], atol=1e-7)
    np.testing.assert_array_equal(read.grasps.q_pregrasp, read.grasps.q)
    T = Rotation.from_euler("xyz", values[:, 3:6])
    np.testing.assert_allclose(read.grasps.object_pose[:, 0, :3], -T.inv().apply(values[:, :3]), atol=1e-6)
    got = Rotation.from_quat(read.grasps.object_pose[:, 0, 3:], scalar_first=True)
    np.testing.assert_allclose((got * T).magnitude(), 0, atol=1e-6)


def test_others_dexgraspbench(tmp_path):
    """Files without joint names, the object anywhere in the world."""
    rng = np.random.default_rng(1)
    q = rng.uniform(-1, 1, (3, 7 + 2))
    q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    q[1:, :7] = q[0, :7]
    world = np.array([0.3, -0.1, 0.5, 0.5, -0.5, 0.5, 0.5])
    keys = ("grasp_qpos", "pregrasp_qpos", "squeeze_qpos")
    entry = dict(zip(keys, q.astype("f4"), strict=True))
    entry |= {"obj_pose": world, "obj_scale": 0.06, "obj_path": "assets/x/core_mug"}
    np.save(tmp_path / "0.npy", np.array(entry, object))
    with pytest.raises(ShardError, match=r"0\.npy: does not name its joints"):
        read_dexgraspbench(tmp_path)
    with pytest.raises(ShardError, match="grasp_qpos has 9 numbers, expected 10"):
        read_dexgraspbench(tmp_path, joint_names=["a", "b", "c"])
    read = read_dexgraspbench(tmp_path, joint_names=["a", "b"])
    assert [(o.code, o.scale) for o in read.objects] == [("core_mug", pytest.approx(0.06))]
    np.testing.assert_allclose(read.grasps.q_squeeze[0], q[2, 7:], atol=1e-6)
    hand = Rotation.from_quat(q[0, 3:7], scalar_first=True)
    np.testing.assert_allclose(read.grasps.object_pose[0, 0, :3], hand.inv().apply(world[:3] - q[0, :3]), atol=1e-6)
    expected = hand.inv() * Rotation.from_quat(world[3:], scalar_first=True)
    got = Rotation.from_quat(read.grasps.object_pose[0, 0, 3:], scalar_first=True)
    assert (got * expected.inv()).magnitude() < 1e-6


ISAAC = """
format: isaac_grasp
format_version: 1.0
object_frame: /World/mug
gripper_frame: /World/panda_hand
grasps:
  "grasp_0":
    confidence: 0.5
    position: [-0.04346, 0.06759, 0.19895]
    orientation: {w: 0.0, xyz: [0.0, 1.0, 0.0]}
    cspace_position: {panda_finger_joint1: 0.00943}
    pregrasp_cspace_position: {panda_finger_joint1: 0.04}
"""


def test_a_part_of_an_export_knows_its_meshes(tmp_path, shards):
    shards.make(tmp_path / "a.h5", n=2)
    export_shards(tmp_path / "a.h5", tmp_path / "out", "dexgraspbench")
    for path in (grasps := tmp_path / "out" / "grasps", grasps / "cup", grasps / "cup" / "00000000.npy"):
        assert [item.mesh for item in read_dexgraspbench(path).objects] == [tmp_path / "out" / "objects" / "cup.obj"]


def test_others_isaac_grasp(tmp_path):
    (tmp_path / "mug.yaml").write_text(ISAAC)
    read = read_isaac_grasp(tmp_path / "mug.yaml")
    assert read.joint_names == ("panda_finger_joint1",)
    assert read.grasps.q_pregrasp[0, 0] == np.float32(0.04)
    assert read.grasps.q_squeeze[0, 0] == np.float32(0.00943)
    np.testing.assert_allclose(read.grasps.object_pose[0, 0, :3], [-0.04346, -0.06759, 0.19895], atol=1e-7)
    for old, new, words in [
        ("format_version: 1.0", "format_version: 2.0", "expected isaac_grasp 1.0"),
        ("isaac_grasp", "other", "expected isaac_grasp 1.0"),
        ("position: [-0.04346,", "position: [", "pose has 6 numbers, expected 1 x 7"),
        ("position: [-0.04346,", "position: [1, 2, 3, 4, 5, 6, 7, 8,", "pose has 14 numbers, expected 1 x 7"),
        ("orientation", "turn", "grasp_0: not a grasp of isaac_grasp 1.0: it has no 'orientation'"),
        ("[-0.04346", "[x", "pose holds no numbers: could not convert"),
        ("{panda_finger_joint1: 0.04}", "{finger: 0.04}", "it has no 'panda_finger_joint1'"),
        ("grasps:", "grasps: [", "not an isaac_grasp file"),
    ]:
        (tmp_path / "mug.yaml").write_text(ISAAC.replace(old, new))
        with pytest.raises(ShardError, match=words) as caught:
            read_isaac_grasp(tmp_path / "mug.yaml")
        assert str(caught.value).startswith(str(tmp_path / "mug.yaml"))
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"obj_pose": None}, "it has no 'obj_pose'"),
        ({"obj_pose": np.zeros(3)}, "obj_pose has 3 numbers, expected 7"),
        ({"grasp_qpos": np.full(9, np.nan)}, "grasp_qpos is not finite"),
        ({"joint_names": ["a", "c"]}, "lacks joint 'b'"),
        ({"joint_names": ["a", "a"]}, "joint 'a' is named twice"),
        ({"obj_path": 3}, "obj_path is 3"),
        ({"obj_scale": "big"}, "scale holds no numbers"),
        ({"obj_scale": np.nan}, "scale is not finite"),
        ({"squeeze_qpos": "text"}, "squeeze_qpos holds no numbers"),
    ],
)
def test_wrong_dexgraspbench(tmp_path, changes, words):
    entry = {key: np.eye(9)[3] for key in ("grasp_qpos", "pregrasp_qpos", "squeeze_qpos")}
    entry |= {"obj_pose": np.eye(7)[3], "obj_scale": 1.0, "obj_path": "x.obj", "joint_names": ["a", "b"]} | changes
    save_object(tmp_path / "a.npy", {key: value for key, value in entry.items() if value is not None})
    with pytest.raises(ShardError, match=words):
        read_dexgraspbench(tmp_path, joint_names=["a", "b"])


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({}, "entry 0: not a grasp of DexGraspNet: it has no 'qpos'"),
        ({"qpos": {"a": 1.0}}, "it has no 'WRJTx'"),
        ({"qpos": {"WRJTx": "x"}}, "it has no 'WRJTy'"),
        ({"qpos": dict.fromkeys(["WRJTx", "WRJTy", "WRJTz", "WRJRx", "WRJRy", "WRJRz", "b"], 0.0)}, "lacks joint 'a'"),
        (
            {"qpos": dict.fromkeys(["WRJTx", "WRJTy", "WRJTz", "WRJRx", "WRJRy", "WRJRz", "a"], np.nan)},
            "qpos is not finite",
        ),
    ],
)
def test_wrong_dexgraspnet(tmp_path, entry, words):
    save_objects(tmp_path / "a.npy", 1, [entry])
    with pytest.raises(ShardError, match=words):
        read_dexgraspnet(tmp_path / "a.npy", joint_names=["a"] if "lacks" in words else None)


@pytest.mark.parametrize("form", FORMATS)
def test_damaged_exports(tmp_path, shards, form):
    shards.make(tmp_path / "a.h5", n=2)
    export_shards(tmp_path / "a.h5", tmp_path / "out", form.replace("-", "_"))
    with pytest.raises(ConfigError, match="choose one of"):
        read_grasps(tmp_path / "out", "h5")
    other = next(name for name in FORMATS if name != form)
    with pytest.raises(ShardError):
        read_grasps(tmp_path / "out", other)
    with pytest.raises(ShardError, match="lacks joint 'x'"):
        read_grasps(tmp_path / "out", form, joint_names=["x", *shards.hand("allegro").joint_names[1:]])
    file = next(path for path in sorted((tmp_path / "out" / "grasps").rglob("*")) if path.is_file())
    data = file.read_bytes()
    for broken in (data[: len(data) // 2], b"", b"nonsense"):
        file.write_bytes(broken)
        with pytest.raises(ShardError, match=file.name):
            read_grasps(tmp_path / "out", form)
    file.write_bytes(data)
    (tmp_path / "out" / "export.json").unlink()
    with pytest.raises(ShardError, match="incomplete"):
        read_grasps(tmp_path / "out", form)
    with pytest.raises(ShardError, match="no such file or folder"):
        read_grasps(tmp_path / "nothing", form)


def test_a_single_scene_is_not_enough(tmp_path):
    (tmp_path / "a.xml").write_text("<mujoco/>")
    with pytest.raises(ShardError, match="only scenes of a whole export"):
        read_mjcf(tmp_path / "a.xml")


@pytest.mark.parametrize("form", ["dexgraspnet", "mjcf"])
def test_what_was_read_makes_a_shard(tmp_path, shards, form):
    """The way in: rows of another format become a shard that conforms."""
    shard = shards.make(tmp_path / "a.h5", "barrett")
    export_shards(tmp_path / "a.h5", tmp_path / "out", form)
    read = read_grasps(tmp_path / "out", form)
    assert isinstance(read.grasps, GraspRows)
    header = ShardHeader(pipeline="imported", seed=0, shard_index=0)
    write_shard(tmp_path / "b.h5", Shard(header=header, hand=shard.hand, objects=shard.objects, grasps=read.grasps))
    assert validate_shard(tmp_path / "b.h5") == []
    np.testing.assert_allclose(read_shard(tmp_path / "b.h5").grasps.q, shard.grasps.q, atol=1e-6)


def test_names_with_odd_characters(tmp_path, shards):
    """YAML and formats must survive percent signs, colons and quotes in names."""
    from dataclasses import replace

    hand = shards.hand("allegro")
    odd = 'j%d: "x" #'
    text = hand.urdf.replace('"joint_3.0"', f"'{odd}'")
    made = replace(hand, urdf=text, joint_names=tuple(odd if n == "joint_3.0" else n for n in hand.joint_names))
    shard = shards.make(tmp_path / "a.h5", made, n=2)
    for form in FORMATS:
        export_shards(tmp_path / "a.h5", tmp_path / form, form)
        np.testing.assert_allclose(read_grasps(tmp_path / form, form).grasps.q, shard.grasps.q, atol=1e-6)
    entry = yaml.safe_load((tmp_path / "isaac-grasp" / "grasps" / "cup.yaml").read_text())["grasps"]["grasp_1"]
    assert entry["cspace_position"][odd] == pytest.approx(shard.grasps.q[1, made.joint_names.index(odd)], abs=1e-6)
