"""lgrasp simulate: verdicts beside the rows of shards, in place or in copies."""

import json
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import h5py
import numpy as np
import pytest
from support.jaws import EDGE, Jaws
from support.shards import write_manifest
from support.simulators import need
from support.twins import twin_rows, twin_shard

from lgrasp.dataset import extend
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine import shard_job
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import CancelledError
from lgrasp.engine.listing import Renewing
from lgrasp.engine.run import run
from lgrasp.jobs import simulate
from lgrasp.jobs.requests.shards import SimulateRequest
from lgrasp.simulate.verdict import FREE_LIFT_COLUMNS
from lgrasp_cli.progress import JobProgress

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")


@pytest.fixture
def grasps(tmp_path):
    """A folder of two shards: one grasp that holds, and two that press too little."""
    jaws = Jaws(tmp_path)
    write_shard(tmp_path / "grasps" / "jaws-cube-00000.h5", jaws.shard(0.004))
    write_shard(tmp_path / "grasps" / "jaws-cube-00001.h5", jaws.shard(0.0001, count=2))
    return tmp_path / "grasps"


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


def test_goes_on_where_it_was(cli, grasps, tmp_path):
    """What is there stays byte for byte; damage is made anew; a second protocol adds its own columns."""
    out = tmp_path / "verdicts"
    assert cli("simulate", grasps, "--out", out, "--json", "-").code == 0
    kept, lost = sorted(out.glob("*.h5"))
    bytes_before = kept.read_bytes()
    lost.write_bytes(lost.read_bytes()[:-50])
    again = cli("simulate", grasps, "--out", out, "--json", "-")
    (entry,) = json.loads(again.out)["results"]
    assert (entry["rows"], entry["held"]) == (3, 1)
    assert kept.read_bytes() == bytes_before
    assert not validate_shard(lost)
    line = cli("simulate", grasps, "--out", out, "--protocol", "gravity6").error()
    assert "belongs to another run (it has no verdicts of this protocol)" in line


def test_in_place(cli, grasps, tmp_path):
    """What has its verdicts stays as it is; a second protocol adds its own; other settings replace only when asked."""
    write_manifest(grasps)
    first, second = sorted(grasps.glob("*.h5"))
    assert cli("simulate", first).code == 0
    bytes_before = first.read_bytes()
    data = json.loads(cli("simulate", grasps, "--json", "-").out)
    assert (data["made"], data["present"], data["shards"]) == (2, 1, [first.name, second.name])
    assert first.read_bytes() == bytes_before
    assert cli("dataset", "check", grasps).code == 0  # the manifest has the new sizes
    assert cli("simulate", grasps, "--protocol", "gravity6").code == 0
    physics = read_shard(first).grasps.physics
    assert {"fc_holds", "gravity6_holds"} <= set(physics)
    line = cli("simulate", grasps, "--all-directions").error()
    assert "has other verdicts of fc (all_directions: False there, True requested); --overwrite replaces them" in line
    assert cli("simulate", grasps, "--all-directions", "--overwrite").code == 0
    assert (read_shard(second).grasps.physics["fc_directions"] >= 0).all()
    assert json.loads(cli("simulate", grasps, "--json", "-").out)["made"] == 0  # all directions are more than is asked
    assert cli("dataset", "check", grasps).code == 0
    assert sorted(path.name for path in grasps.iterdir()) == [first.name, second.name, "manifest.json"]


def test_verdicts_that_are_replaced_go_as_a_whole(cli, grasps, tmp_path):
    """With those that only the numbers before gave; protocols of like names stay."""
    config = tmp_path / "sim.yaml"

    def simulate_with(**protocol):
        config.write_text(json.dumps({"job": "simulate", "shards": [str(grasps)], "protocol": protocol}))
        assert cli("run", config, "--overwrite").code == 0

    simulate_with(name="mine", draws={"count": 2})
    simulate_with(name="mine_too", draws={"count": 2})
    simulate_with(name="mine", friction=0.3)
    physics = set(read_shard(min(grasps.glob("*.h5"))).grasps.physics)
    assert {"mine_holds", "mine_too_holds", "mine_too_share"} <= physics
    assert "mine_share" not in physics


def test_objects_of_one_name_are_told_apart(cli, grasps, tmp_path):
    """A mug of another size has another mass."""
    (path, _) = sorted(grasps.glob("*.h5"))
    shard = read_shard(path)
    small = [replace(o, vertices=0.5 * o.vertices) for o in shard.objects]
    write_shard(path, replace(shard, objects=small))
    data = json.loads(cli("simulate", grasps, "--protocol", "gravity6", "--json", "-").out)
    assert len({entry["object"] for entry in data["results"]}) == 1
    assert len({entry["mass"] for entry in data["results"]}) == 2


def test_killed_while_it_replaces_a_shard(cli, grasps, tmp_path, monkeypatch):
    """The list says nothing of the size of a file that is being replaced, so that nobody calls it damaged."""
    write_manifest(grasps)
    seen = []

    def die(source, out, **added):
        seen.append(cli("status", grasps).out)
        extend_shard(source, out, **added)
        seen.append(cli("status", grasps).out)
        raise MemoryError

    extend_shard = shard_job.extend_shard
    monkeypatch.setattr(shard_job, "extend_shard", die)
    monkeypatch.setattr(Renewing, "close", lambda self: None)
    assert cli("simulate", grasps).code == 2
    assert len(seen) == 2
    assert not any("damaged" in text for text in seen)
    monkeypatch.undo()
    assert cli("simulate", grasps).code == 0
    assert cli("dataset", "check", grasps).code == 0


def test_a_shard_that_is_replaced_meanwhile(cli, grasps, tmp_path, monkeypatch):
    """Verdicts never get to rows that they are not of."""
    path, other = sorted(grasps.glob("*.h5"))
    stored, judge = other.read_bytes(), simulate.verdicts

    def replacing(*args, **options):
        path.write_bytes(stored)
        return judge(*args, **options)

    monkeypatch.setattr(simulate, "verdicts", replacing)
    assert "its rows were replaced while they were worked on; run it again" in cli("simulate", path).error()
    assert path.read_bytes() == stored


def test_two_processes_at_one_shard(grasps, cache_root, monkeypatch):
    """What both add is in it; what replaces it while columns are added stays."""
    path, other = sorted(grasps.glob("*.h5"))
    new, adding, finish = read_shard(other), threading.Event(), extend.finish
    monkeypatch.setattr(extend, "finish", lambda file: (adding.set(), time.sleep(0.3), finish(file)))

    def simulated(name):
        return run(SimulateRequest(shards=(path,), protocol=name).job(Cache(cache_root))).made

    with ThreadPoolExecutor() as pool:
        assert list(pool.map(simulated, ("fc", "gravity6"))) == [1, 1]
        assert {"fc_holds", "gravity6_holds"} <= read_shard(path).grasps.physics.keys()
        adding.clear()
        last = pool.submit(simulated, "dipgrasp")
        assert adding.wait(30)
        write_shard(path, new)
        assert last.result() == 1
    assert len(read_shard(path).grasps) == len(new.grasps)


def test_verdicts_so_far_are_kept(cli, grasps, tmp_path, monkeypatch, shared_cache):
    """A run that was cut goes on with the rows after the last block, and the verdicts are those of a whole run."""
    path = grasps / "jaws-cube-00001.h5"
    shard = Jaws(tmp_path).shard(0.004, count=5)
    squeeze = shard.grasps.q_squeeze.copy()
    squeeze[::2] = shard.grasps.q[::2] - 0.0001
    write_shard(path, replace(shard, grasps=replace(shard.grasps, q_squeeze=squeeze)))
    assert cli("simulate", path, "--out", tmp_path / "whole").code == 0
    monkeypatch.setattr(simulate, "_FIRST", 2)
    monkeypatch.setattr(simulate, "_BLOCK_SECONDS", 0.0)
    run, blocks = simulate.verdicts, []

    def cut(scene, rows, *more, **options):
        blocks.append(rows.candidate.tolist())
        if len(blocks) == 3:
            raise CancelledError
        return run(scene, rows, *more, **options)

    monkeypatch.setattr(simulate, "verdicts", cut)
    result = cli("simulate", path, "--workers", 1)
    assert result.code == 130
    assert "interrupted: verdicts of 3 grasps are kept; the same command makes the rest" in result.err
    told = []
    monkeypatch.setattr(JobProgress, "advanced", lambda self, part, done, note, ahead, kept: told.append((done, kept)))
    result = cli("simulate", path, "--workers", 1, "--json", "-")
    assert result.code == 0, result
    assert list(dict.fromkeys(told)) == [(4, 3), (5, 3)]  # those of the run before are no work of this one
    assert blocks == [[0, 1], [2], [3], [3], [4]]
    (entry,) = json.loads(result.out)["results"]
    assert (entry["rows"], entry["held"]) == (5, 2)
    found, whole = (read_shard(file).grasps.columns() for file in (path, tmp_path / "whole" / path.name))
    for name in whole:
        np.testing.assert_array_equal(found[name], whole[name], err_msg=name)
    assert not list((shared_cache / "verdicts").glob("*"))


def test_bad_input(cli, grasps, tmp_path, monkeypatch):
    assert "--protocol 'fall': choose fc" in cli("simulate", grasps, "--protocol", "fall").error()
    assert "no such file or folder" in cli("simulate", tmp_path / "nothing").error()
    assert "would be overwritten" in cli("simulate", grasps, "--out", grasps).error()
    before = {path: path.read_bytes() for path in grasps.iterdir()}
    (tmp_path / "text.h5").write_text("no shard")
    assert "not a whole HDF5 file" in cli("simulate", tmp_path / "text.h5", "--out", tmp_path / "a").error()
    heavy = Jaws(tmp_path).shard(0.004)
    urdf = heavy.hand.urdf.replace("</link>", '<inertial><mass value="-1"/></inertial></link>', 1)
    write_shard(tmp_path / "heavy" / "a.h5", Jaws(tmp_path).shard(0.004, urdf=urdf))
    assert "MuJoCo refuses hand 'jaws'" in cli("simulate", tmp_path / "heavy").error()
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert 'pip install "lgrasp[sim]"' in cli("simulate", grasps).error()
    assert not (tmp_path / "a").exists()
    assert {path: path.read_bytes() for path in grasps.iterdir()} == before


def test_interruption_leaves_whole_shards(process, grasps, tmp_path):
    write_shard(grasps / "jaws-cube-00002.h5", Jaws(tmp_path).shard(0.004, count=2000))
    out = tmp_path / "out"
    running = process("simulate", grasps, "--out", out, "--threads", 1)
    until = time.monotonic() + 30
    while len(list(out.glob("*.h5"))) < 2 and time.monotonic() < until:
        time.sleep(0.05)
    running.send_signal(signal.SIGINT)
    _, errors = running.communicate(timeout=30)
    assert running.returncode == 130
    assert errors.splitlines()[-1].startswith("interrupted")
    names = ["jaws-cube-00000.h5", "jaws-cube-00001.h5"]
    assert sorted(path.name for path in out.iterdir()) == [*names, "manifest.json"]
    assert not any(validate_shard(out / name) for name in names)


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
