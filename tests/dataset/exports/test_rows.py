"""Which rows are exported, and what is refused."""

import json
import os
import tarfile
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from lxml import etree
from pxr import Usd

from lgrasp.dataset.conditions import Condition, parse_condition
from lgrasp.dataset.exports.formats import FORMATS, export_shards, read_grasps
from lgrasp.dataset.exports.npy import load_objects
from lgrasp.dataset.reader import ShardReader
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import ConfigError, LgraspError, OutputError, ShardError
from lgrasp.geometry.poses import pose_matrix

SINGLE = [name for name, form in FORMATS.items() if form.single]


def exported(source, out, **options):
    export_shards(source, out, "dexgraspnet", **options)
    return read_grasps(out, "dexgraspnet").grasps


def test_conditions_and_limit(tmp_path, shards):
    holds = np.array([True, False, True, True, False, True])
    first = shards.make(tmp_path / "a.h5", holds=holds).grasps
    second = shards.make(tmp_path / "b.h5", seed=1, holds=holds).grasps
    q, seen = np.concatenate([first.q, second.q]), []
    for number, (options, rows) in enumerate(
        [
            ({"limit": 8}, range(8)),
            ({"where": ["physics/fc_holds"], "limit": 5}, [0, 2, 3, 5, 6]),
            ({"where": ["physics/fc_holds", "metrics/epsilon>=0.5"]}, [3, 5, 9, 11]),
        ]
    ):
        got = exported(tmp_path, tmp_path / f"out{number}", advance=lambda *done: seen.append(done), **options)
        np.testing.assert_array_equal(got.q, q[list(rows)])
        assert seen[-1] == (len(rows), len(rows))
    index = json.loads((tmp_path / "out2" / "export.json").read_text())
    assert (index["rows"], index["where"]) == (4, ["physics/fc_holds", "metrics/epsilon >= 0.5"])


def test_negatives_are_left_out_and_told(tmp_path, shards, monkeypatch):
    """Unless a condition names their metric; a shard without negatives has valid rows only."""
    made = [shards.make(tmp_path / f"{name}.h5", seed=seed) for seed, name in enumerate("ab")]
    rows = made[1].grasps
    metrics, units = rows.metrics | {"valid": np.array([1, 0, 1, 0, 1, 1], "f4")}, rows.metric_units | {"valid": ""}
    write_shard(tmp_path / "b.h5", replace(made[1], grasps=replace(rows, metrics=metrics, metric_units=units)))
    q, told = np.concatenate([shard.grasps.q for shard in made]), []
    monkeypatch.setattr("lgrasp.dataset.exports.formats.notice", told.append)
    for number, (where, rows) in enumerate(
        [((), [*range(7), 8, 10, 11]), (["metrics/valid >= 0"], range(12)), (["metrics/valid == 0"], [7, 9])]
    ):
        got = exported(tmp_path, tmp_path / f"out{number}", where=where)
        np.testing.assert_array_equal(got.q, q[list(rows)])
    assert told == ["2 rows left out, as metric valid is 0; --where 'metrics/valid >= 0' takes them, too"]
    assert "; 2 with metric valid 0 are left out" in (tmp_path / "out0" / "README.txt").read_text()
    assert json.loads((tmp_path / "out0" / "export.json").read_text())["negatives_left_out"] == 2


def test_failed_verdicts_lower_the_confidence(tmp_path, shards):
    shards.make(tmp_path / "a.h5", n=3, holds=np.array([True, False, True]))
    export_shards(tmp_path / "a.h5", tmp_path / "out", "isaac-grasp")
    text = (tmp_path / "out" / "grasps" / "cup.yaml").read_text()
    assert [line.split()[1] for line in text.splitlines() if "confidence" in line] == ["1.0", "0.0", "1.0"]


def entries(folder, form: str) -> list[dict]:
    """What is written of each grasp of the cup."""
    if form == "isaac-grasp":
        grasps = yaml.safe_load((folder / "grasps" / "cup.yaml").read_text())["grasps"]
        return [grasps[f"grasp_{number}"] for number in range(len(grasps))]
    if form == "graspgen":
        lists = json.loads((folder / "grasps" / "cup.json").read_text())["grasps"]
        lists.pop("joint_names")
        return [dict(zip(lists, entry, strict=True)) for entry in zip(*lists.values(), strict=True)]
    if form == "usd":
        stage = Usd.Stage.Open(str(folder / "grasps" / "cup.usdc"))  # prims are gone with it
        hand = stage.GetPrimAtPath("/World/hand")
        names = [a.GetName() for a in hand.GetAttributes() if "table" in a.GetName()]
        return [{n.removeprefix("lgrasp:"): hand.GetAttribute(n).Get(t) for n in names} for t in range(4)]
    if form == "webdataset":
        with tarfile.open(folder / "grasps" / "train-00000.tar") as tar:
            return [json.loads(tar.extractfile(member).read()) for member in tar]
    if form == "dexgraspnet":
        return load_objects(folder / "grasps" / "cup.npy")
    return [load_objects(file)[0] for file in sorted((folder / "grasps" / "cup").iterdir())]


@pytest.mark.parametrize("form", SINGLE)
def test_tables_come_along(tmp_path, shards, form):
    """Plane and approach in the object's frame; the shard has the approach in the hand's."""
    shard, planes = shards.make(tmp_path / "plain.h5", n=4), np.array([[0, 0, 1, -0.025], [0, 1, 0, -0.005]], "f4")
    pose, way = np.array([1, 0, 1, 1], "i4"), np.array([[0, 0, -1], [0, -1, 0], [0.6, 0, -0.8], [1, 0, 0]], "f4")
    rows = replace(shard.grasps, table={"pose": pose, "approach": way})
    cup = replace(shard.objects[0], tables=np.column_stack([planes, np.full((2, 1), 0.5, "f4")]))
    write_shard(tmp_path / "table.h5", replace(shard, grasps=rows, objects=[cup]))
    export_shards(tmp_path / "table.h5", tmp_path / "out", form)
    R = pose_matrix(rows.object_pose[:, 0].astype(float))[:, :3, :3]
    for row, entry in enumerate(entries(tmp_path / "out", form)):
        np.testing.assert_allclose(entry["table_plane"], planes[pose[row]], atol=1e-6)
        np.testing.assert_allclose(R[row] @ entry["table_approach"], way[row], atol=1e-6)
    assert "table_plane" in (tmp_path / "out" / "README.txt").read_text()
    np.testing.assert_allclose(read_grasps(tmp_path / "out", form).grasps.q, rows.q, atol=1e-6)
    export_shards(tmp_path / "plain.h5", tmp_path / "without", form)
    assert "table" not in (tmp_path / "without" / "README.txt").read_text()
    assert not any("table_plane" in entry for entry in entries(tmp_path / "without", form))


@pytest.mark.parametrize(
    ("text", "condition"),
    [
        ("physics/fc_holds", Condition("physics/fc_holds")),
        ("metrics/epsilon > 0.01", Condition("metrics/epsilon", ">", 0.01)),
        ("metrics/a-b<=-1e-3", Condition("metrics/a-b", "<=", -1e-3)),
        ("  candidate==7 ", Condition("candidate", "==", 7)),
    ],
)
def test_conditions_are_read(text, condition):
    assert parse_condition(text) == condition


@pytest.mark.parametrize("text", ["", "a b", "a >> 1", "a > ", "a > b", "> 1", "a > nan"])
def test_conditions_that_cannot_be_read(text):
    with pytest.raises(ConfigError, match="--where"):
        parse_condition(text)


def test_conditions_on_large_numbers(tmp_path, shards):
    """They are compared, and told, to the last digit."""
    shard = shards.make(tmp_path / "a.h5", n=3)
    rows = replace(shard.grasps, candidate=np.array([2**53, 2**53 + 1, 7], np.uint64))
    write_shard(tmp_path / "a.h5", replace(shard, grasps=rows))
    with ShardReader(tmp_path / "a.h5") as reader:
        for text in ("candidate == 9007199254740993", "metrics/epsilon > 0.123456789", "candidate < 0.5"):
            assert str(parse_condition(text)) == text
        assert parse_condition("candidate == 9007199254740993").holds(reader).tolist() == [False, True, False]
        assert parse_condition("candidate >= -1").holds(reader).all()


def test_an_export_killed_while_it_replaces_another_is_gone_on_with(tmp_path, shards, monkeypatch):
    shards.make(tmp_path / "a.h5", n=4, objects=[shards.object("jug")])
    shards.make(tmp_path / "b.h5", n=3)
    again = {"run_key": "b", "replaces": True}
    export_shards(tmp_path / "a.h5", tmp_path / "out", "dexgraspbench", run_key="a")
    removed: list[Path] = []

    def unlink(path: Path, missing_ok: bool = False) -> None:
        removed.append(path)
        if len(removed) == 3:
            raise KeyboardInterrupt
        os.remove(path)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", unlink)
        with pytest.raises(KeyboardInterrupt):
            export_shards(tmp_path / "b.h5", tmp_path / "out", "dexgraspnet", **again)
    with pytest.raises(ShardError, match="the export is incomplete"):
        read_grasps(tmp_path / "out", "dexgraspbench")
    with pytest.raises(OutputError, match="is not empty"):
        export_shards(tmp_path / "b.h5", tmp_path / "out", "dexgraspnet", run_key="c", replaces=True)
    export_shards(tmp_path / "b.h5", tmp_path / "out", "dexgraspnet", **again)
    export_shards(tmp_path / "b.h5", tmp_path / "fresh", "dexgraspnet", **again)
    out, fresh = (sorted(p.relative_to(top) for p in top.rglob("*")) for top in (tmp_path / "out", tmp_path / "fresh"))
    assert out == fresh


def several(shards, path):
    """Rows of a cup and a ball, of a ball alone in the second place, of a cup."""
    objects = [shards.object("ball", "2"), shards.object("cup", "1")]
    return shards.make(path, n=3, objects=objects, index=np.array([[1, 0], [-1, 0], [1, -1]]))


@pytest.mark.parametrize("form", SINGLE)
def test_several_objects_are_refused(tmp_path, shards, form):
    several(shards, tmp_path / "a.h5")
    with pytest.raises(ShardError, match=r"a\.h5: row 0 holds 2 objects, this format one; .* 'objects == 1', or --to"):
        export_shards(tmp_path / "a.h5", tmp_path / "out", form)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("form", "where"), [("dexgraspnet", "candidate > 0"), ("usd", "objects == 1")])
def test_rows_of_one_object_each_beside_others(tmp_path, shards, form, where):
    """The shard has room for two objects in a row; the chosen rows hold one each."""
    shard = several(shards, tmp_path / "a.h5").grasps
    export_shards(tmp_path / "a.h5", tmp_path / "out", form, where=[where])
    read = read_grasps(tmp_path / "out", form)
    assert [read.objects[i].code for i in read.grasps.object_index[:, 0]] == ["ball", "cup"]
    expected = pose_matrix(shard.object_pose[[1, 2], [1, 0]])
    np.testing.assert_allclose(pose_matrix(read.grasps.object_pose[:, 0]), expected, atol=1e-5)


def test_scenes_hold_several_objects(tmp_path, shards):
    mujoco = pytest.importorskip("mujoco")
    shard = several(shards, tmp_path / "a.h5").grasps
    export_shards(tmp_path / "a.h5", tmp_path / "out", "mjcf")
    read = read_grasps(tmp_path / "out", "mjcf")
    codes = [[read.objects[i].code for i in row if i >= 0] for row in read.grasps.object_index]
    assert codes == [["cup", "ball"], ["ball"], ["cup"]]
    pose = read.grasps.object_pose
    np.testing.assert_allclose(pose_matrix(pose[0]), pose_matrix(shard.object_pose[0]), atol=1e-5)
    np.testing.assert_allclose(pose_matrix(pose[1, 0]), pose_matrix(shard.object_pose[1, 1]), atol=1e-5)
    assert np.isnan(pose[1, 1]).all()
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "grasps" / "00000000.xml"))
    assert model.nq == 16 + 14


def test_one_object_twice_in_the_hand(tmp_path, shards):
    """As a sequence of equal objects has it: bodies of their own, each where its slot says."""
    pytest.importorskip("mujoco")
    shard = shards.make(tmp_path / "a.h5", n=2, index=np.array([[0, -1, -1], [0, 0, 0]])).grasps
    export_shards(tmp_path / "a.h5", tmp_path / "out", "mjcf", where=["objects >= 3"])
    read = read_grasps(tmp_path / "out", "mjcf")
    assert read.grasps.object_index.tolist() == [[0, 0, 0]]
    np.testing.assert_allclose(pose_matrix(read.grasps.object_pose[0]), pose_matrix(shard.object_pose[1]), atol=1e-5)
    names = etree.parse(tmp_path / "out" / "grasps" / "00000000.xml").xpath("//body[@name]/@name")
    assert [name for name in names if name.startswith("object_")] == ["object_0_cup", "object_1_cup", "object_2_cup"]


def test_objects_of_one_name_stay_apart(tmp_path, shards):
    shards.make(tmp_path / "a.h5", n=1, objects=[shards.object("..my cup", "1")])
    shards.make(tmp_path / "b.h5", n=2, objects=[shards.object("..my cup", "2")], seed=1)
    shards.make(tmp_path / "c.h5", n=3, objects=[shards.object("..my cup", "1")], seed=2)
    done = export_shards(tmp_path, tmp_path / "out", "dexgraspbench")
    assert done == (6, ("my_cup", "my_cup_2"))
    assert len(list((tmp_path / "out" / "grasps" / "my_cup").iterdir())) == 4
    assert len(list((tmp_path / "out" / "grasps" / "my_cup_2").iterdir())) == 2
    assert {p.name for p in (tmp_path / "out" / "objects").iterdir()} == {"my_cup.obj", "my_cup_2.obj"}


def test_bad_input_leaves_nothing(tmp_path, shards):
    shards.make(tmp_path / "a.h5")
    shards.make(tmp_path / "b.h5", "barrett")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("x")
    (tmp_path / "file").write_text("x")
    for source, out, options, error, words in [
        ("a.h5", "full", {}, OutputError, "full is not empty"),
        ("a.h5", "file", {}, OutputError, "file is a file"),
        ("a.h5", "out", {"limit": 0}, ConfigError, "--limit 0"),
        ("a.h5", "out", {"where": ["physics/fc_holds"]}, ShardError, "lgrasp simulate adds"),
        (
            "a.h5",
            "out",
            {"where": ["q > 1"]},
            ShardError,
            "column 'q' has several numbers per row; with one number per row it has objects, candidate, ",
        ),
        ("a.h5", "out", {"where": ["metrics/epsilon > 2"]}, ShardError, "none satisfies metrics/epsilon > 2"),
        ("c.h5", "out", {}, ShardError, "no such file"),
        (".", "out", {}, ShardError, r"b\.h5: another hand"),
    ]:
        with pytest.raises(error, match=words):
            export_shards(tmp_path / source, tmp_path / out, "dexgraspnet", **options)
    with pytest.raises(ConfigError, match="dexgraspnet, dexgraspbench, isaac-grasp, graspgen, usd, mjcf"):
        export_shards(tmp_path / "a.h5", tmp_path / "out", "urdf")
    assert {p.name for p in tmp_path.iterdir()} == {"a.h5", "b.h5", "full", "file"}
    assert [p.name for p in (tmp_path / "full").iterdir()] == ["mine"]


def test_a_hand_that_cannot_be_used_is_named(tmp_path, shards):
    """Nothing is begun with it, and what it was to replace stays."""
    hand = shards.hand("allegro")
    shards.make(tmp_path / "b.h5", hand, n=2)
    export_shards(tmp_path / "b.h5", tmp_path / "before", "dexgraspnet")
    for urdf, words in [
        ("<robot", "not XML"),
        (hand.urdf.replace('name="joint_3.0"', 'name="other"'), "no movable joint 'joint_3.0'"),
        (
            hand.urdf.replace(
                "<collision>", '<collision><geometry><mesh filename="x.stl"/></geometry></collision><collision>', 1
            ),
            "x.stl",
        ),
    ]:
        shards.make(tmp_path / "a.h5", hand, n=1)
        with h5py.File(tmp_path / "a.h5", "r+") as file:
            file["hand/urdf"][()] = urdf
            del file.attrs["text_sha256"]
        for form in ("dexgraspnet", "mjcf"):
            with pytest.raises(LgraspError, match=words):
                export_shards(tmp_path / "a.h5", tmp_path / "out", form)
            assert not (tmp_path / "out").exists()
            with pytest.raises(LgraspError, match=words):
                export_shards(tmp_path / "a.h5", tmp_path / "before", form, replaces=True)
            assert len(read_grasps(tmp_path / "before", "dexgraspnet").grasps) == 2


def test_what_any_simulator_saw_fail(tmp_path, shards):
    """Rows that held in one simulator and failed in another are no grasps that hold."""
    shard = shards.make(tmp_path / "a.h5", holds=np.array([True, True, False, True, True, True]))
    told = {"physx_fc_holds": np.array([True, False, True, True, True, True])}
    physics = dict(shard.grasps.physics) | told
    protocols = dict(shard.grasps.physics_protocols) | dict.fromkeys(told, "{}")
    write_shard(
        tmp_path / "a.h5", replace(shard, grasps=replace(shard.grasps, physics=physics, physics_protocols=protocols))
    )
    export_shards(tmp_path / "a.h5", tmp_path / "out", "graspgen")
    (file,) = (tmp_path / "out" / "grasps").glob("*.json")
    held = json.loads(file.read_text())["grasps"]["object_in_gripper"]
    assert held == [True, False, False, True, True, True]
