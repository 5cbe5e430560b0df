"""lgrasp simulate: verdicts beside the rows of shards, in place or in copies."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from support.jaws import EDGE
from support.simulators import need
from support.twins import twin_rows, twin_shard

from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.simulate.verdict import FREE_LIFT_COLUMNS

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")


@pytest.mark.parametrize("place", ["in place", "copies"])
def test_adds_columns_and_keeps_the_rest(cli, grasps, tmp_path, raw_grasps, place):
    folder = grasps if place == "in place" else tmp_path / "copies"
    old = {path.name: read_shard(path) for path in grasps.glob("*.h5")}
    stored = raw_grasps(grasps)
    result = cli("simulate", grasps, *(["--out", folder] if place == "copies" else []))
    assert result.code == 0, result
    assert result.out.splitlines()[1].split()[:4] == ["jaws", "cube", "3", "33.3%"]
    for number, holds in ((0, [True]), (1, [False, False])):
        name = f"jaws-cube-0000{number}.h5"
        before, after = old[name], read_shard(folder / name)
        assert not validate_shard(folder / name)
        assert stored[name].items() <= raw_grasps(folder)[name].items()
        for column, values in before.grasps.columns().items():
            np.testing.assert_array_equal(values, after.grasps.columns()[column], err_msg=column)
        assert after.grasps.physics["fc_holds"].tolist() == holds
        assert after.grasps.physics["fc_directions"].dtype == np.int8
        protocol = json.loads(after.grasps.physics_protocols["fc_slip"])
        assert (protocol["name"], protocol["timestep"], protocol["objects"][0]["mass"]) == ("fc", 0.004, 0.1)
        assert after.header.config == before.header.config
        assert after.statistics["fc_held"] == sum(holds)


@pytest.mark.parametrize("engine", ["physx", "drake"])
def test_another_simulator_adds_its_own_columns(cli, grasps, engine: str):
    need(engine)
    for name in ("mujoco", engine, engine):
        result = cli("simulate", grasps, "--engine", name)
        assert result.code == 0, result
    rows = read_shard(grasps / "jaws-cube-00000.h5").grasps
    assert rows.physics["fc_holds"].tolist() == rows.physics[f"{engine}_fc_holds"].tolist() == [True]
    protocol = json.loads(rows.physics_protocols[f"{engine}_fc_holds"])
    assert (protocol["engine"], protocol["simulator"][:5]) == (engine, engine)
    assert "torsion" in protocol["solver"]["not_used"]
    assert json.loads(rows.physics_protocols["fc_holds"])["engine"] == "mujoco"
    assert cli("simulate", grasps, "--engine", "bullet").code == 2


def test_verdicts_of_another_solver_are_not_taken_for_these(cli, grasps):
    """Contacts of PhysX were once found by persistent manifolds, and shards did not say so."""
    need("physx")
    path = min(grasps.glob("*.h5"))
    assert cli("simulate", path, "--engine", "physx").code == 0
    with h5py.File(path, "r+") as file:
        del file.attrs["text_sha256"]
        for name, column in file["grasps/physics"].items():
            if name.startswith("physx_fc"):
                protocol = json.loads(column.attrs["protocol"])
                assert protocol["solver"].pop("persistent_contacts") is False
                column.attrs["protocol"] = json.dumps(protocol, sort_keys=True)
    result = cli("simulate", path, "--engine", "physx")
    assert result.code == 2
    assert "solver.persistent_contacts: True there, False requested" in result.err
    assert cli("simulate", path, "--engine", "physx", "--overwrite").code == 0
    assert cli("simulate", path, "--engine", "physx").code == 0


def test_random_draws(cli, grasps, tmp_path):
    """The shares that hold in all draws and on the mean; readers take the columns, beside those of fc."""
    path, other = sorted(grasps.glob("*.h5"))
    shard = read_shard(other)
    write_shard(other, replace(shard, header=replace(shard.header, shard_index=1)))
    assert cli("simulate", grasps).code == 0
    for _ in range(2):
        result = cli("simulate", grasps, "-p", "fc_random", "--json", tmp_path / "report.json")
        assert result.code == 0, result
        head, line = result.out.splitlines()[:2]
        assert "hold in all  hold, mean" in head
        assert line.split()[:5] == ["jaws", "cube", "3", "33.3%", "33.3%"]
        assert "8 draws of each grasp, friction 0.4 to 0.8" in result.out
    (entry,) = json.loads((tmp_path / "report.json").read_text())["results"]
    assert (entry["held"], entry["share"], entry["friction"]) == (1, pytest.approx(1 / 3), None)
    shard = read_shard(path)
    assert not validate_shard(path)
    assert shard.grasps.physics["fc_random_holds"].tolist() == shard.grasps.physics["fc_holds"].tolist() == [True]
    share = shard.grasps.physics["fc_random_share"]
    assert (share.dtype, share.tolist()) == (np.float32, [1.0])
    assert json.loads(shard.grasps.physics_protocols["fc_random_share"])["draws"]["seed"] == 0
    assert cli("simulate", grasps, "-p", "fc_random", "--verbose").code == 0
    page, data = tmp_path / "page.html", tmp_path / "data.json"
    assert cli("dataset", "report", grasps, "--out", page, "--json", data).code == 0
    (told,) = json.loads(data.read_text())["hands"][0]["objects"]
    means = {protocol: found["means"] for protocol, found in told["physics"].items()}
    assert "draws [%]" in page.read_text()
    assert means["fc_random"]["share"] == pytest.approx(1 / 3)
    assert means["fc"].keys() == means["fc_random"].keys() - {"share"}
    assert cli("dataset", "merge", path, other, "--out", tmp_path / "all.h5").code == 0
    chosen = ("--to", "mjcf", "--where", "physics/fc_random_share >= 0.9")
    exported = cli("export", tmp_path / "all.h5", *chosen, "--out", tmp_path / "mjcf", "--json", "-")
    assert exported.code == 0, exported
    assert json.loads(exported.out)["grasps"] == 1


def test_several_objects(cli, tmp_path):
    """A line for every set of objects held, in the order of their slots; verdicts of each object beside its row."""
    rows = twin_rows(count=3)
    pose, index, links = rows.object_pose.copy(), rows.object_index.copy(), rows.contact_links.copy()
    pose[1, 1, 2] += 0.3  # in the air
    absent = {"object_pose": pose, "object_index": index, "contact_links": links}
    absent |= {n: getattr(rows, n).copy() for n in ("contact_points", "contact_normals", "contact_forces")}
    for name, values in absent.items():
        values[2, 1] = -1 if name in ("object_index", "contact_links") else np.nan
    path = tmp_path / "twins" / "a.h5"
    write_shard(path, twin_shard(replace(rows, **absent)))
    result = cli("simulate", path.parent, "--protocol", "seq6", "--json", tmp_path / "report.json")
    assert result.code == 0, result
    lines = [line.split() for line in result.out.splitlines()[:3]]
    assert [line[1:4] for line in lines] == [
        ["object", "grasps", "hold"],
        ["one", "1", "100.0%"],
        ["one+two", "2", "50.0%"],
    ]
    assert lines[0][4] == "stay"
    one, both = json.loads((tmp_path / "report.json").read_text())["results"]
    assert (one["objects"], both["objects"], both["stay"]) == (["one"], ["one", "two"], 1)
    assert both["mass"] == pytest.approx(2 * one["mass"])
    assert not validate_shard(path)
    found = read_shard(path).grasps
    assert found.physics["seq6_object_touches"].tolist() == [[1, 1], [1, 0], [1, -1]]
    objects = json.loads(found.physics_protocols["seq6_holds"])["objects"]
    assert [entry["name"] for entry in objects] == ["one", "two"]


def test_one_object_beside_several(cli, grasps):
    """Whether objects stay is told of several only."""
    write_shard(grasps / "twins.h5", twin_shard(twin_rows()))
    result = cli("simulate", grasps)
    assert result.code == 0, result
    heads, *lines = (line.split() for line in result.out.splitlines()[:3])
    assert {line[1]: line[heads.index("stay")] for line in lines} == {"cube": "-", "one+two": "100.0%"}


def test_one_object_in_a_shard_of_several(cli, tmp_path):
    """It has the columns of several, which rows of the same object in a shard of one have not."""
    rows, slots = twin_rows(), ("object_pose", "object_index", "contact_points", "contact_normals", "contact_forces")
    alone = {name: getattr(rows, name)[:, :1] for name in (*slots, "contact_links")}
    shard = twin_shard(replace(rows, **alone))
    write_shard(tmp_path / "in" / "b.h5", replace(shard, objects=shard.objects[:1]))
    absent = {name: getattr(rows, name).copy() for name in alone}
    for name, values in absent.items():
        values[:, 1] = -1 if name in ("object_index", "contact_links") else np.nan
    write_shard(tmp_path / "in" / "a.h5", twin_shard(replace(rows, **absent)))
    found = json.loads(cli("simulate", tmp_path / "in", "--json", "-").out)["results"]
    assert [(entry["objects"], entry["rows"], entry["stay"]) for entry in found] == [
        (["one"], 1, 1),
        (["one"], 1, None),
    ]


def test_validate_is_the_old_name(cli, grasps, tmp_path):
    result = cli("validate", grasps, "--out", tmp_path / "old", "--json", tmp_path / "report.json")
    assert result.code == 0, result
    assert "'lgrasp validate' is now 'lgrasp simulate'" in result.err
    data = json.loads((tmp_path / "report.json").read_text())
    (entry,) = data["results"]
    assert entry["held"] == 1
    seconds = read_shard(tmp_path / "old" / "jaws-cube-00000.h5").statistics
    assert 0 < float(seconds["seconds_fc_compile"]) <= data["seconds_compile"]
    assert entry["per_s"] == pytest.approx(entry["rows"] / entry["seconds"])
    assert entry["seconds"] + data["seconds_compile"] <= data["seconds"]["total"]


def test_what_a_shard_holds_besides_is_copied(cli, grasps, tmp_path):
    """Members that the format does not know stay."""
    path = grasps / "jaws-cube-00000.h5"
    with h5py.File(path, "a") as file:
        file.create_group("notes").attrs["by"] = "someone"
    assert "delete that attribute if they are yours" in cli("simulate", path, "--out", tmp_path / "out").error()
    assert not (tmp_path / "out").exists()
    with h5py.File(path, "a") as file:
        del file.attrs["text_sha256"]
    assert cli("simulate", path, "--out", tmp_path / "out").code == 0
    with h5py.File(tmp_path / "out" / path.name) as file:
        assert file["notes"].attrs["by"] == "someone"
    assert validate_shard(tmp_path / "out" / path.name) == []


def test_dipgrasp_needs_no_table(cli, grasps, tmp_path):
    """The columns of what is lifted without a table are read and reported, the second time from what is there."""
    path = sorted(grasps.glob("*.h5"))[0]
    for _ in range(2):
        result = cli("simulate", path, "-p", "dipgrasp", "--verbose", "--json", tmp_path / "report.json")
        assert result.code == 0, result
        assert result.out.splitlines()[1].split()[:4] == ["jaws", "cube", "1", "100.0%"]
    (entry,) = json.loads((tmp_path / "report.json").read_text())["results"]
    assert (entry["held"], entry["on_table"], entry["pushed"], entry["directions_held"]) == (1, None, None, None)
    assert not validate_shard(path)
    assert set(read_shard(path).grasps.physics) == {f"dipgrasp_{column}" for column in FREE_LIFT_COLUMNS}
    assert cli("dataset", "report", path, "--out", tmp_path / "page.html").code == 0


def test_lift_needs_a_table(cli, grasps, tmp_path):
    """One line for grasps without a table; the columns of those that have one are read and reported."""
    line = cli("simulate", grasps, "--protocol", "lift").error()
    assert "lgrasp generate --table" in line
    path = sorted(grasps.glob("*.h5"))[0]
    shard = read_shard(path)
    down = np.array([[0, 0, 1]], "f4")
    plane = np.array([[0, 0, -1, -EDGE / 2, 1.0]], "f4")
    pose = shard.grasps.object_pose.copy()
    pose[..., 2] = 0.078
    rows = replace(shard.grasps, object_pose=pose, table={"pose": np.zeros(1, "i4"), "approach": down})
    write_shard(path, replace(shard, objects=[replace(shard.objects[0], tables=plane)], grasps=rows))
    said = cli("simulate", grasps, "-p", "lift", "--out", tmp_path / "lifted")  # the other shard is without a table
    assert said.code == 0, said
    assert "left out" in said.err
    assert [file.name for file in (tmp_path / "lifted").rglob("*.h5")] == [path.name]
    for more in ((), ("--all-directions",)):  # which lift has none of: the second time from what is there
        result = cli("simulate", path, "-p", "lift", "--verbose", "--json", tmp_path / "report.json", *more)
        assert result.code == 0, result
        assert result.out.splitlines()[1].split()[:4] == ["jaws", "cube", "1", "100.0%"]
    (entry,) = json.loads((tmp_path / "report.json").read_text())["results"]
    assert (entry["held"], entry["on_table"], entry["directions_held"]) == (1, 0, None)
    assert not validate_shard(path)
    assert cli("dataset", "report", path, "--out", tmp_path / "page.html", "--json", tmp_path / "data.json").code == 0
    told = json.loads((tmp_path / "data.json").read_text())["hands"][0]["objects"][0]["physics"]["lift"]
    assert (told["held"], told["means"]["on_table"]) == (1, 0)
