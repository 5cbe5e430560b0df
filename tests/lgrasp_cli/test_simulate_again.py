"""lgrasp simulate: what is there already, is replaced, or was cut off."""

import json
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from support.jaws import Jaws
from support.shards import write_manifest

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
from lgrasp_cli.progress import JobProgress

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")


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


def test_verdicts_of_another_version_are_not_taken(cli, grasps, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(simulate.SimulateJob, "version", 7)
        patch.setattr(sys.modules["lgrasp.simulate.run"], "VERDICT_VERSION", 7)
        assert cli("simulate", grasps).code == 0
        assert cli("simulate", grasps).code == 0
    line = cli("simulate", grasps).error()
    assert "has other verdicts of fc (by another version of lgrasp); --overwrite replaces them" in line
    assert cli("simulate", grasps, "--overwrite").code == 0
    assert json.loads(cli("simulate", grasps, "--json", "-").out)["made"] == 0


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
    data = json.loads(result.out)
    assert (data["made"], data["present"]) == (2, 3)
    assert list(dict.fromkeys(told)) == [(4, 3), (5, 3)]  # those of the run before are no work of this one
    assert blocks == [[0, 1], [2], [3], [3], [4]]
    (entry,) = data["results"]
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
