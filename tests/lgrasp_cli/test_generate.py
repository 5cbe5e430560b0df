"""The main job from the command line: report, resume, plan, arrays, starvation, interruption."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lgrasp.dataset.conditions import Condition
from lgrasp.dataset.exports.selection import select_rows
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.report.write import read_dataset
from lgrasp.dataset.torch_dataset import GraspDataset
from lgrasp.dataset.validate import validate_shard
from lgrasp.grasp.bounds import GraspBounds

KEYS = {
    "grasps",
    "strict_valid_per_s",
    "published_count_per_s",
    "seconds",
    "survivors",
    "near_duplicates",
    "distinct_poses",
    "peak_rss_mb",
    "device",
    "peak_device_mb",
}
STAGES = {"place", "domain", "ik", "search", "filter"}


def test_report(generate, tmp_path):
    result = generate("--shard-rows", 8, "--json", tmp_path / "report.json")
    assert (result.code, result.err) == (0, "")
    told = dict(re.split(r"  +", line) for line in result.out.splitlines())
    assert list(told) == ["grasps", "diversity", "force closure", "time", "where", "next"]
    assert told["grasps"] == "20 of 20 requested"
    assert told["next"] == f"lgrasp simulate {tmp_path / 'out'}"
    assert "survivors " in generate("--shard-rows", 8, "--verbose").out
    data = json.loads((tmp_path / "report.json").read_text())
    assert set(data) >= KEYS
    assert set(data["survivors"]) == STAGES
    assert set(data["seconds"]) >= STAGES | {"hand", "object", "field", "total"}
    assert data["grasps"] == data["made"] == 20
    assert 0 < data["distinct_poses"] <= 20
    assert data["near_duplicates"] == 0
    assert 0 < data["published_count"] <= 20
    assert data["strict_valid_per_s"] == pytest.approx(20 / data["seconds"]["wall"])
    assert data["peak_rss_mb"] > 50
    assert data["peak_device_mb"] == 0
    paths = sorted((tmp_path / "out").glob("*.h5"))
    assert [p.name for p in paths] == data["shards"]
    assert [len(read_shard(p).grasps) for p in paths] == [8, 8, 4]
    assert not [line for p in paths for line in validate_shard(p)]


def test_table(generate, tmp_path):
    result = generate("--table", "--json", tmp_path / "report.json")
    assert (result.code, result.err) == (0, "")
    poses = json.loads((tmp_path / "report.json").read_text())["resting"]
    some = [pose for pose in poses if pose["rows"]]
    assert f"{len(some)} of {len(poses)} have grasps" in result.out
    assert sum(pose["rows"] for pose in poses) == 20
    (path,) = (tmp_path / "out").glob("*.h5")
    assert sorted(set(read_shard(path).grasps.table["pose"].tolist())) == [k for k, p in enumerate(poses) if p["rows"]]


def test_what_is_overwritten_is_not_asked_any_more(cli, generate, tmp_path):
    """Parts of the run before that were never made are no part of the folder."""
    assert generate("--shard-rows", 5, "--array", "0/4").code == 0
    assert generate("--seed", 3, "--overwrite").code == 0
    (run,) = json.loads(cli("status", tmp_path / "out", "--json", "-").out)
    assert (run["seed"], run["state"]) == (3, "complete")
    assert cli("dataset", "check", tmp_path / "out").out == "1 shard valid\n"


def test_negatives(cli, generate, tmp_path):
    """The same grasps, and after them rows that fail the bound that they name; only the first count as grasps."""
    assert generate().code == 0
    both, plain = tmp_path / "both", read_shard(next((tmp_path / "out").glob("*.h5"))).grasps
    data = json.loads(generate("--negatives", 1.5, "--json", "-", out=both).out)
    assert (data["grasps"], data["negatives"], data["strict"]) == (20, 30, 20)
    path = next(both.glob("*.h5"))
    rows, bounds = read_shard(path).grasps, GraspBounds()
    assert (len(rows), validate_shard(path)) == (50, [])
    np.testing.assert_array_equal(rows.valid, np.arange(50) < 20)
    for name in ("q", "q_pregrasp", "q_squeeze", "object_pose", "candidate"):
        np.testing.assert_array_equal(getattr(rows, name)[:20], getattr(plain, name))
    named, limits = rows.failed_bound, {"max_gap": "gap", "max_penetration": "penetration", "max_gswo": "gswo"}
    assert set(named[:20]) == {"none"}
    assert len(set(named[20:])) > 1
    assert all(name in GraspBounds.model_fields for name in named[20:])
    for name, metric in limits.items():
        assert (rows.metrics[metric][named == name] > getattr(bounds, name)).all()
    assert len(GraspDataset(both, columns=["q"])) == 20
    told = GraspDataset(both, negatives=True)
    assert [told.failed_bounds[int(told[k]["metrics/failed_bound"])] for k in (0, 20, 49)] == [*named[[0, 20, 49]]]
    assert read_dataset([both], near=False)[0]["rows"] == 20
    assert json.loads(cli("dataset", "info", both, "--json", "-").out)[0]["invalid"] == 30
    assert [select_rows([both], where=where).rows for where in ((), [Condition("metrics/valid", "==")])] == [20, 30]
    assert json.loads(generate("--negatives", 1.5, "--json", "-", out=both).out)["made"] == 0
    assert "--simulate" in generate("--negatives", 1, "--simulate", "fc", out=tmp_path / "fc").error()


def test_rows_of_looser_bounds_are_not_strict(generate):
    loose = ("--set", "bounds.max_gap=0.01", "--set", "bounds.max_penetration=0.008")
    data = json.loads(generate(*loose, "--json", "-").out)
    assert data["strict"] < data["grasps"] == 20
    assert data["strict_valid_per_s"] == pytest.approx(data["strict"] / data["seconds"]["wall"])
    assert data["grasps_per_s"] == pytest.approx(20 / data["seconds"]["wall"])
    assert "meet only those of the pipeline" in generate(*loose, "--overwrite").out


def test_rows_of_higher_friction_are_not_strict(generate):
    """Their forces were balanced with it, so nothing stored says what they would do with less."""
    assert json.loads(generate("--set", "bounds.friction=0.8", "--json", "-").out)["strict"] == 0


def test_resume_counts_what_is_there(generate, tmp_path):
    generate("--shard-rows", 8)
    (tmp_path / "out" / "allegro-tiny-00001.h5").unlink()
    data = json.loads(generate("--shard-rows", 8, "--json", "-").out)
    assert (data["grasps"], data["made"], data["present"]) == (20, 8, 12)
    data = json.loads(generate("--shard-rows", 8, "--json", "-").out)
    assert (data["made"], data["strict_valid_per_s"]) == (0, 0)
    assert data["survivors"]["filter"] >= 20


def test_more_rows_later(cli, generate, tmp_path):
    """Whole shards stay as they are, verdicts included; the last one is completed, which is told."""
    pytest.importorskip("mujoco")
    generate("--shard-rows", 4, rows=6)
    assert cli("simulate", tmp_path / "out").code == 0
    whole, last = sorted((tmp_path / "out").glob("*.h5"))
    before = whole.read_bytes()
    result = generate("--shard-rows", 4, "--json", "-", rows=8)
    data = json.loads(result.out)
    assert (data["grasps"], data["made"], data["present"]) == (8, 2, 6)
    assert f"{last} has 2 of 4 grasps: it is completed, and its verdicts (fc) are lost" in result.err
    assert whole.read_bytes() == before
    assert "fc_holds" not in read_shard(last).grasps.physics


def test_force_makes_everything_anew(generate):
    generate(rows=2)
    data = json.loads(generate("--json", "-", "--force", rows=2).out)
    assert data["made"] == 2
    assert data["hits"] == {"hand": False, "object": False, "field": False}


def test_another_run_in_the_folder(generate, tmp_path):
    generate()
    before = (tmp_path / "out" / "allegro-tiny-00000.h5").read_bytes()
    assert "belongs to another run (seed: 0 there, 1 requested); choose another --out" in generate("--seed", 1).error()
    assert (tmp_path / "out" / "allegro-tiny-00000.h5").read_bytes() == before
    assert generate("--seed", 1, "--no-resume").code == 0


def test_score(generate, tmp_path):
    assert generate("--score", "gswo", rows=2).code == 0
    stages = read_shard(tmp_path / "out" / "allegro-tiny-00000.h5").header.config["pipeline"]["stages"]
    assert next(stage["search"]["score"] for stage in stages if "search" in stage) == "gswo"
    assert "--score 'gsw': did you mean 'gswo'? choose fswo, gswo" in generate("--score", "gsw").error()


def test_contacts(generate, tmp_path):
    assert generate("--contacts", "2").code == 0
    shard = read_shard(tmp_path / "out" / "allegro-tiny-00000.h5")
    names = list(shard.hand.link_names)
    fingers = [{i for i in row if i >= 0 and names[i] != "base_link"} for row in shard.grasps.contact_links[:, 0]]
    assert {len(found) for found in fingers} == {2}


def snapshot(folder):
    return {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in sorted(folder.rglob("*"))}


@pytest.mark.parametrize("built", [False, True])
def test_dry_run_has_no_side_effects(generate, shared_cache, inputs, tmp_path, built):
    own = ("--cache-dir", tmp_path / "cache")
    if built:
        shutil.copytree(shared_cache / "hand", tmp_path / "cache" / "hand")
        generate("--shard-rows", 8, *own, rows=8)
    before = snapshot(tmp_path)
    result = generate("--shard-rows", 8, "--dry-run", *own)
    assert result.code == 0
    lines = [line.split() for line in result.out.splitlines()]
    states = {(words[0], words[1]): words[2] for words in lines}
    known = "hit" if built else "miss"
    assert [states["hand", "allegro"], states["object", "tiny"], states["field", "allegro"]] == [known] * 3
    assert states["shard", "0"] == ("present" if built else "missing")
    assert states["shard", "2"] == "missing"
    assert snapshot(tmp_path) == before


@pytest.fixture
def slurm(monkeypatch):
    """slurm(task, number): this process is a task of a job array."""

    def be(task, number):
        for name, value in {"ID": task, "MIN": 0, "MAX": number - 1, "STEP": 1, "COUNT": number}.items():
            monkeypatch.setenv(f"SLURM_ARRAY_TASK_{name}", str(value))

    return be


def test_array_tasks_share_the_shards(generate, slurm):
    slurm(1, 2)
    result = generate("--shard-rows", 8, "--json", "-")
    assert json.loads(result.out)["shards"] == ["allegro-tiny-00001.h5"]
    assert result.err == "array task 1 of 2: shard 1\n"
    result = generate("--shard-rows", 8, "--array", "0/2", "--quiet", "--json", "-")
    assert json.loads(result.out)["shards"] == ["allegro-tiny-00000.h5", "allegro-tiny-00002.h5"]
    assert result.err == ""
    assert "--array 2/2" in generate("--array", "2/2").error()
    result = generate("--shard-rows", 8, "--shard-index", 1, "--num-shards", 2, "--json", "-")
    assert json.loads(result.out)["shards"] == ["allegro-tiny-00001.h5"]
    assert "warning: --shard-index and --num-shards are now --array 1/2" in result.err


def test_array_with_an_object_for_each_task(generate, slurm, tmp_path):
    slurm(3, 10)
    line = generate("--quiet").error()
    assert "array task 3 of 10: there is 1 shard to share" in line
    assert "--array off" in line
    assert not (tmp_path / "out").exists()
    assert generate("--array", "off").code == 0
    assert (tmp_path / "out" / "allegro-tiny-00000.h5").exists()


def test_starved_run_keeps_what_it_found(generate, tmp_path, monkeypatch):
    monkeypatch.setattr("lgrasp.engine.shard._LEAST_EFFORT", 256)
    result = generate("--json", tmp_path / "report.json", "--scale", 9, mesh="sphere")
    assert "bottleneck" in result.error(3)
    data = json.loads((tmp_path / "report.json").read_text())
    assert data["starved"]
    assert data["grasps"] < 20
    assert not [line for p in (tmp_path / "out").glob("*.h5") for line in validate_shard(p)]
    again = generate("--scale", 9, mesh="sphere")  # nothing to make, still too few
    assert again.error(3) == result.error(3)


def test_interruption_leaves_whole_shards(process, generate, tmp_path, quick):
    generate(rows=1)  # inputs are cached
    out = tmp_path / "many"
    base = ("--object", "tiny", "--pipeline", quick, "--device", "cpu", "--shard-rows", 8, "--batch", 128)
    running = process("generate", *base, "-n", 10_000, "--out", out)
    until = time.monotonic() + 30
    while not list(out.glob("*.h5")) and time.monotonic() < until:
        time.sleep(0.02)
    running.send_signal(signal.SIGINT)
    output, errors = running.communicate(timeout=30)
    assert running.returncode == 130, errors
    assert "Traceback" not in output + errors
    assert "interrupted" in errors
    shards = sorted(out.glob("*.h5"))
    assert shards
    assert sorted(out.iterdir()) == [*shards, out / "manifest.json"]
    assert {len(read_shard(p).grasps) for p in shards} == {8}
    kept = {p: p.stat().st_mtime_ns for p in shards}
    for folder in (out, tmp_path / "whole"):
        assert generate("--shard-rows", 8, rows=24, out=folder).code == 0
    assert {p: p.stat().st_mtime_ns for p in kept} == kept
    for path in sorted((tmp_path / "whole").glob("*.h5")):
        whole, resumed = read_shard(path).grasps.columns(), read_shard(out / path.name).grasps.columns()
        assert {name: np.asarray(values).tobytes() for name, values in whole.items()} == {
            name: np.asarray(values).tobytes() for name, values in resumed.items()
        }


def catches(process: subprocess.Popen[str], number: int) -> bool:
    """True once a process handles a signal."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    return bool(int(status.partition("SigCgt:")[2].split()[0], 16) >> (number - 1) & 1)


@pytest.mark.parametrize("delay", [0.0, 1.0])
def test_interruption_while_loading(process, tmp_path, delay):
    running = process("generate", "--object", "mug", "-n", 1_000_000, "--out", tmp_path / "out")
    while not catches(running, signal.SIGTERM):
        time.sleep(0.005)
    time.sleep(delay)
    running.send_signal(signal.SIGINT)
    _, errors = running.communicate(timeout=30)
    assert running.returncode == 130
    assert "Traceback" not in errors
    assert errors.splitlines()[-1].startswith("interrupted")


def test_report_into_a_device(generate):
    assert "No space" in generate("--json", "/dev/full").error()
    assert os.stat("/dev/full").st_rdev


def test_closed_pipe_is_quiet(process):
    running = process("pipelines", "show", "swift")
    assert running.stdout is not None
    running.stdout.close()
    running.stdout = None
    _, errors = running.communicate(timeout=30)
    assert errors == ""
    assert running.returncode == 141


def test_closed_streams(tmp_path):
    """Nothing is said, and no file that is opened takes the place of a stream."""
    command = f"exec {sys.executable} -m lgrasp_cli pipelines list --json pipelines.json <&- >&- 2>&-"
    assert subprocess.run(["sh", "-c", command], cwd=tmp_path, timeout=60, check=False).returncode == 0
    assert "swift" in [pipeline["name"] for pipeline in json.loads((tmp_path / "pipelines.json").read_text())]


def test_debug_shows_the_traceback_too(cli, monkeypatch):
    monkeypatch.setenv("LGRASP_DEBUG", "1")
    found = cli("hands", "show", "nobody")
    assert found.code == 2
    first, *_, last = found.err.splitlines()
    assert first.startswith("Traceback")
    assert last.startswith("error: unknown hand 'nobody'")


def test_the_first_kernels_of_a_machine_are_announced(generate, monkeypatch, tmp_path):
    monkeypatch.setattr("lgrasp.runtime.kernels.is_compiled", lambda module, cuda: False)
    assert "compiling kernels once for this machine" in generate(rows=1).err.splitlines()[0]
    quiet = generate("--quiet", rows=1, out=tmp_path / "quiet")
    assert (quiet.code, quiet.out, quiet.err) == (0, "", "")


def test_physics_is_the_old_name_of_simulate(generate):
    result = generate("--physics", "fd")
    assert result.code == 2
    notice, error = result.err.splitlines()
    assert "--physics is now --simulate" in notice
    assert "--simulate 'fd': choose fc, gravity6" in error
    assert generate("--simulate", "fd").error() == error
