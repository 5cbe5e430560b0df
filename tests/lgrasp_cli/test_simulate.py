"""lgrasp simulate: the shards again, with verdicts."""

import json
import signal
import sys
import time
from dataclasses import replace

import h5py
import numpy as np
import pytest
from support.jaws import Jaws
from support.twins import twin_rows, twin_shard

from lgrasp.dataset import read_shard, validate_shard, write_shard

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")


@pytest.fixture
def grasps(tmp_path):
    """A folder of two shards: one grasp that holds, and two that press too little."""
    jaws = Jaws(tmp_path)
    write_shard(tmp_path / "grasps" / "jaws-cube-00000.h5", jaws.shard(0.004))
    write_shard(tmp_path / "grasps" / "jaws-cube-00001.h5", jaws.shard(0.0001, count=2))
    return tmp_path / "grasps"


def test_adds_columns_and_keeps_the_rest(cli, grasps, tmp_path):
    result = cli("simulate", grasps)
    assert result.code == 0, result
    head, row = (line.split() for line in result.out.splitlines()[:2])
    assert row[: head.index("+x")] == ["jaws", "cube", "3", "33.3%"]
    for number, holds in ((0, [True]), (1, [False, False])):
        name = f"jaws-cube-0000{number}.h5"
        before, after = read_shard(grasps / name), read_shard(tmp_path / "grasps-fc" / name)
        assert not validate_shard(tmp_path / "grasps-fc" / name)
        for column, values in before.grasps.columns().items():
            np.testing.assert_array_equal(values, after.grasps.columns()[column], err_msg=column)
        assert after.grasps.physics["fc_holds"].tolist() == holds
        assert after.grasps.physics["fc_directions"].dtype == np.int8
        protocol = json.loads(after.grasps.physics_protocols["fc_slip"])
        assert (protocol["name"], protocol["timestep"], protocol["objects"][0]["mass"]) == ("fc", 0.004, 0.1)
        assert after.header.config == before.header.config
        assert after.statistics["fc_held"] == sum(holds)


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
    out = tmp_path / "twins-seq6" / "a.h5"
    assert not validate_shard(out)
    found = read_shard(out).grasps
    assert found.physics["seq6_object_touches"].tolist() == [[1, 1], [1, 0], [1, -1]]
    objects = json.loads(found.physics_protocols["seq6_holds"])["objects"]
    assert [entry["name"] for entry in objects] == ["one", "two"]


def test_goes_on_where_it_was(cli, grasps, tmp_path):
    """What is there stays byte for byte; damage is made anew; a second protocol adds its own columns."""
    out = tmp_path / "verdicts"
    assert cli("simulate", grasps, "--out", out, "--json", "-").code == 0
    kept, lost = sorted(out.iterdir())
    bytes_before = kept.read_bytes()
    lost.write_bytes(lost.read_bytes()[:-50])
    again = cli("simulate", grasps, "--out", out, "--json", "-")
    (entry,) = json.loads(again.out)["results"]
    assert (entry["rows"], entry["held"]) == (3, 1)
    assert kept.read_bytes() == bytes_before
    assert not validate_shard(lost)
    line = cli("simulate", grasps, "--out", out, "--protocol", "gravity6").error()
    assert "another protocol" in line
    assert cli("simulate", out, "--out", tmp_path / "both", "--protocol", "gravity6").code == 0
    physics = read_shard(tmp_path / "both" / kept.name).grasps.physics
    assert {"fc_holds", "gravity6_holds"} <= set(physics)


def test_bad_input(cli, grasps, tmp_path, monkeypatch):
    assert "unknown protocol 'fall'; choose fc" in cli("simulate", grasps, "--protocol", "fall").error()
    assert "no such file or folder" in cli("simulate", tmp_path / "nothing").error()
    assert "would be overwritten" in cli("simulate", grasps, "--out", grasps).error()
    (tmp_path / "text.h5").write_text("no shard")
    assert "not a whole HDF5 file" in cli("simulate", tmp_path / "text.h5", "--out", tmp_path / "a").error()
    heavy = Jaws(tmp_path).shard(0.004)
    urdf = heavy.hand.urdf.replace("</link>", '<inertial><mass value="-1"/></inertial></link>', 1)
    write_shard(tmp_path / "heavy" / "a.h5", Jaws(tmp_path).shard(0.004, urdf=urdf))
    assert "MuJoCo refuses hand 'jaws'" in cli("simulate", tmp_path / "heavy").error()
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert 'pip install "lgrasp[sim]"' in cli("simulate", grasps).error()
    assert not (tmp_path / "a").exists()
    assert not (tmp_path / "grasps-fc").exists()


def test_interruption_leaves_whole_shards(process, grasps, tmp_path):
    write_shard(grasps / "jaws-cube-00002.h5", Jaws(tmp_path).shard(0.004, count=20_000))
    out = tmp_path / "out"
    running = process("simulate", grasps, "--out", out, "--threads", 1)
    until = time.monotonic() + 30
    while len(list(out.glob("*.h5"))) < 2 and time.monotonic() < until:
        time.sleep(0.05)
    running.send_signal(signal.SIGINT)
    _, errors = running.communicate(timeout=30)
    assert running.returncode == 130
    assert errors.splitlines()[-1].startswith("interrupted")
    assert sorted(path.name for path in out.iterdir()) == ["jaws-cube-00000.h5", "jaws-cube-00001.h5"]
    assert not any(map(validate_shard, out.iterdir()))


def test_validate_is_the_old_name(cli, grasps, tmp_path):
    result = cli("validate", grasps, "--out", tmp_path / "old", "--json", tmp_path / "report.json")
    assert result.code == 0, result
    assert "'lgrasp validate' is now 'lgrasp simulate'" in result.err
    data = json.loads((tmp_path / "report.json").read_text())
    (entry,) = data["results"]
    assert entry["held"] == 1
    seconds = read_shard(tmp_path / "old" / "jaws-cube-00000.h5").statistics
    assert 0 < seconds["seconds_fc_compile"] <= data["seconds_compile"]
    assert entry["per_s"] == pytest.approx(entry["rows"] / entry["seconds"])
    assert entry["seconds"] + data["seconds_compile"] <= data["seconds"]["total"]


def test_what_a_shard_holds_besides_is_copied(cli, grasps, tmp_path):
    """Members that the format does not know stay."""
    path = grasps / "jaws-cube-00000.h5"
    with h5py.File(path, "a") as file:
        file.create_group("notes").attrs["by"] = "someone"
    assert cli("simulate", path, "--out", tmp_path / "out").code == 0
    with h5py.File(tmp_path / "out" / path.name) as file:
        assert file["notes"].attrs["by"] == "someone"
    assert validate_shard(tmp_path / "out" / path.name) == []
