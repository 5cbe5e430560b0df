"""The other commands: inputs, stages one by one, lists, configs, cache, bench."""

import json
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.shards import sample_shard

from lgrasp.dataset.writer import write_shard
from lgrasp.engine.run import run
from lgrasp.jobs.lanes import Lanes

STAGES = ["place", "domain", "ik", "search", "filter"]


def test_build_field(cli, quick):
    first = json.loads(cli("build-field", "allegro", "-p", quick, "--json", "-").out)
    assert first["vectors"] == 80_000
    assert len(first["clear_share"]) == first["groups"] == 4
    again = json.loads(cli("build-field", "allegro", "-p", quick, "--json", "-").out)
    assert again["cached"]
    assert "clear of the palm" in cli("build-field", "allegro", "-p", quick).out
    assert "'kd'" in cli("build-field", "allegro", "--index", "kd").error()


def test_preprocess(cli, quick):
    first = json.loads(cli("preprocess", "tiny", "-p", quick, "--rebuild", "--json", "-").out)
    assert first["watertight"]
    assert first["faces"] == 168
    assert not first["cached"]
    assert json.loads(cli("preprocess", "tiny", "-p", quick, "--json", "-").out)["cached"]
    assert "watertight" in cli("preprocess", "tiny", "-p", quick).out


@pytest.mark.parametrize("order", ["quick", "published"])
def test_stages_use_the_cache(cli, tmp_path, shared_cache, order, quick):
    pipeline, stages = quick, STAGES
    if order == "published":
        text = Path(quick).read_text()
        pipeline = tmp_path / "published.yaml"
        pipeline.write_text(text.replace("  - ik: {}\n  - search: {}\n", "  - search: {}\n  - ik: {}\n"))
        stages = ["place", "domain", "search", "ik", "filter"]
    base = ("--object", "tiny", "-p", pipeline, "--candidates", 128, "--device", "cpu")
    for n, stage in enumerate(stages):
        result = cli(stage, *base)
        assert result.code == 0, result.err
        lines = result.out.splitlines()
        assert [line.split()[0] for line in lines[1:-1]] == stages[: n + 1]
        states = [line.split()[1] for line in lines[1:-1]]
        assert states[:n] == ["hit"] * n
        assert (shared_cache / stage).is_dir()
        assert lines[-1].startswith(str(shared_cache / stage))
    again = json.loads(cli("filter", *base, "--json", "-").out)
    assert [run["hit"] for run in again] == [True] * 5
    assert again[-1]["counts"]["kept"] > 0
    other = json.loads(cli("place", *base, "--first", 128 * len(order), "--json", "-").out)
    assert not other[0]["hit"]
    assert "'--candidates'" in cli("place", "--object", "tiny", "--candidates", 0).error()


def test_a_damaged_table_is_made_anew(cli, quick):
    base = ("domain", "--object", "tiny", "-p", quick, "--candidates", 64, "--device", "cpu", "--json", "-")
    first = json.loads(cli(*base).out)
    with open(first[-1]["path"], "r+b") as file:
        file.truncate(1000)
    result = cli(*base)
    assert [run["hit"] for run in json.loads(result.out)] == [True, False]
    assert "damaged" in result.err


def test_hands(cli):
    assert "allegro" in cli("hands", "list").out
    data = json.loads(cli("hands", "show", "allegro", "--json", "-").out)
    assert len(data["joints"]) == 16
    assert {joint["finger"] for joint in data["joints"]} == {0, 1, 2, 3}
    assert "joint_12.0" in cli("hands", "show", "allegro").out
    assert "did you mean 'allegro'" in cli("hands", "show", "alegro").error()


def test_a_data_folder_that_is_not_there(cli, monkeypatch, tmp_path):
    monkeypatch.setenv("LGRASP_PATH", os.pathsep.join(map(str, (tmp_path, tmp_path / "lost"))))
    listed = cli("pipelines", "list")
    assert (listed.code, listed.err.count("LGRASP_PATH"), listed.err.count("lost is no folder")) == (0, 1, 1)


def test_objects(cli):
    assert {"mug", "tiny"} <= {entry["name"] for entry in json.loads(cli("objects", "list", "--json", "-").out)}
    assert "mug" in cli("objects", "list").out
    shown = json.loads(cli("objects", "show", "tiny", "--json", "-").out)
    mesh = trimesh.load_mesh(shown["file"])
    assert shown["volume"] == pytest.approx(mesh.volume)
    np.testing.assert_allclose(shown["center_of_mass"], mesh.center_mass, atol=1e-6)
    assert f"{1e6 * mesh.volume:,.1f} cm³" in cli("objects", "show", "tiny").out
    assert "did you mean" in cli("objects", "show", "tinny").error()


def test_objects_are_made_once_for_a_seed(cli, tmp_path):
    make = ("objects", "make", "-n", 4, "--kind", "mug", "--kind", "bottle", "--out")
    assert cli(*make, "a", "--json", "-").code == 0
    names = ["bottle-0-0.obj", "bottle-0-1.obj", "mug-0-0.obj", "mug-0-1.obj"]
    made = {path.name: path.read_bytes() for path in sorted((tmp_path / "a").iterdir())}
    assert list(made) == names
    assert len(set(made.values())) == 4
    (tmp_path / "a" / names[0]).unlink()
    assert json.loads(cli(*make, "a", "--json", "-").out)["written"] == 1
    assert (tmp_path / "a" / names[0]).read_bytes() == made[names[0]]
    alone = cli("objects", "make", "-n", 2, "--kind", "mug", "--out", "b")
    assert "2 written now" in "".join(alone.out.split("of which "))
    assert (tmp_path / "b" / "mug-0-1.obj").read_bytes() == made["mug-0-1.obj"]  # whatever else is made
    assert "another mesh" in cli(*make, "a", "--size", "0.04:0.12").error()
    assert json.loads(cli(*make, "a", "--size", "0.04:0.12", "--overwrite", "--json", "-").out)["written"] == 4
    for wrong in ("5:12", "0.05", "x", "0.1:0.05"):
        assert "0.005 to 1 m" in cli(*make, "c", "--size", wrong).error()
    assert "did you mean 'mug'" in cli("objects", "make", "--kind", "mag", "--out", "c").error()
    assert not (tmp_path / "c").exists()


def test_pipelines(cli):
    names = [entry["name"] for entry in json.loads(cli("pipelines", "list", "--json", "-").out)]
    assert "swift" in names
    rows = json.loads(cli("pipelines", "show", "swift", "--json", "-").out)["parameters"]
    assert all(meaning for *_, meaning in rows)
    assert "iterations" in cli("pipelines", "show", "swift").out


def test_json_without_a_path_is_standard_output_with_a_notice(cli):
    found = cli("objects", "list", "--json")
    assert found.out == cli("objects", "list", "--json", "-").out
    (line,) = found.err.splitlines()
    assert line.startswith("warning: --json takes a path")


def test_cache(cli, tmp_path, shared_cache, quick):
    assert cli("cache", "path").out.strip() == str(shared_cache)
    own = ("--cache-dir", tmp_path / "cache")
    cli("preprocess", "tiny", "-p", quick, *own)
    listed = cli("cache", "list", *own).out
    assert [line.split()[:2] for line in listed.splitlines()[1:2]] == [["object", "1"]]
    assert len(json.loads(cli("cache", "list", "--json", "-", *own).out)) == 1
    assert "object" in cli("cache", "list", "--files", *own).out
    assert "say what" in cli("cache", "prune", *own).error()
    assert "'objekt'" in cli("cache", "prune", "--kind", "objekt", *own).error()
    assert cli("cache", "prune", "--older-than", 1, *own).out.startswith("0 files")
    assert cli("cache", "prune", "--all", *own).out.startswith("1 files")


def test_run(cli, tmp_path, quick):
    config = tmp_path / "c.yaml"
    config.write_text(f"objects: [tiny, nothing, sphere]\npipelines: [{quick}]\nrows: 10\nout: made\ndevice: cpu\n")
    plan = cli("run", config, "--dry-run")
    assert "nothing" in plan.error()
    assert not (tmp_path / "made").exists()
    result = cli("run", config, "--json", tmp_path / "r.json", "-n", 5)
    assert result.code == 2
    data = json.loads((tmp_path / "r.json").read_text())
    assert [job["status"] for job in data["jobs"]] == ["done", "failed", "done"]
    assert data["exit_code"] == 2
    assert [line.split()[-1] for line in result.out.splitlines()[1:]] == ["done", "failed", "done"]
    made = sorted(p.relative_to(tmp_path / "made").parts[0] for p in (tmp_path / "made").rglob("*.h5"))
    assert made == ["allegro-sphere", "allegro-tiny"]


def test_run_by_an_array(cli, tmp_path, quick, monkeypatch):
    """Tasks share the shards of all jobs; only more tasks than these are refused."""
    config = tmp_path / "c.yaml"
    config.write_text(f"objects: [tiny, sphere]\npipelines: [{quick}]\nrows: 5\nout: made\ndevice: cpu\n")
    for task, states in enumerate((["done", "of other tasks"], ["of other tasks", "done"])):
        data = json.loads(cli("run", config, "--array", f"{task}/2", "--json", "-").out)
        assert [job["status"] for job in data["jobs"]] == states
    assert len(list((tmp_path / "made").rglob("*.h5"))) == 2
    for name, value in {"ID": 0, "MIN": 0, "MAX": 2, "STEP": 1, "COUNT": 3}.items():
        monkeypatch.setenv(f"SLURM_ARRAY_TASK_{name}", str(value))
    result = cli("run", config)
    assert result.code == 2
    assert "array task 0 of 3: there are 2 shards to share" in result.err


def test_run_on_several_devices(cli, tmp_path, monkeypatch):
    """A config names them as the option does, which replaces its own."""
    given = []

    class Recorded(Lanes):
        def outcome(self, number, job, events):
            given.append([device.alias for device in self._devices])
            return run(job, events)

    monkeypatch.setattr("lgrasp.jobs.lanes.Lanes", Recorded)
    write_shard(tmp_path / "in" / "toy-cup-00000.h5", sample_shard(3))
    config = "job: metrics\nshards: [in]\nadd: [volume]\nout: out\nworkers: 1\ndevice: cpu,cpu\n"
    (tmp_path / "c.yaml").write_text(config)
    for more, lanes in ((), [["cpu", "cpu"]]), (("--device", "cpu"), []), (("--device", "cpu,cpu,cpu"), [["cpu"] * 3]):
        given.clear()
        assert cli("run", "c.yaml", *more).code == 0
        assert given == lanes


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("objects: [tiny]\nrow: 5", "did you mean 'rows'"),
        ("object: [tiny]", "did you mean 'objects'"),
        ("objects: [tiny]\nn: 5", "did you mean 'rows'"),
        ("objects: [tiny]\nset: []", "did you mean 'settings'"),
        ("objects: [tiny]\nfingers: [thumb]", "it is a key of 'steer'"),
        ("job: learn\nshards: [x]\nsteps: 3", "it is a key of 'params'"),
        ("objects: []", "objects"),
        ("objects: tiny", "key 'objects' = 'tiny': give a list: [tiny]"),
        ("objects: [tiny]\nrows: 0", "rows"),
        ("objects: [tiny]\nrows: many", "key 'rows' = 'many': give a whole number"),
        ("objects: [tiny]\nrows: 5\nrows: 6", "line 3: key 'rows' is given twice"),
        ("job: sequence\nobjects: [tiny, tiny]\npipeline: sequnce", "did you mean 'sequence'"),
        ("job: sequence\nobjects: [tiny, tiny]\nseed: x", "c.yaml: key 'seed' = 'x': give a whole number"),
        ("objects: [tiny]\npipelines: [swfit]", "did you mean 'swift'"),
        ("objects: [tiny]\nobject_dir: nowhere", "nowhere"),
        ("objects: [tiny]\nheld_out: [tiny]", "held_out: none of the 1 objects is left"),
        ("objects: [tiny]\npipelines: [swift, ./swift.yaml]", "pipelines swift and ./swift.yaml have one name"),
        ("objects: [tiny]\nsequences: {sets: 1}\nsimulate: fc", "simulate: of sequences it is a key of 'sequences'"),
        ("objects: [tiny]\nsequences: {sets: 1}\ntable: true", "table: of sequences it is no key"),
        ("objects: [tiny]\nsequences: {sets: 1}\nscale: 0.001", "scale: of sequences it is a key of 'sequences'"),
        ("objects: [tiny]\ndevice: cpu,gpu", "key 'device' = 'cpu,gpu': device 'gpu' cannot be"),
    ],
)
def test_wrong_configs(cli, tmp_path, text, words):
    (tmp_path / "c.yaml").write_text(text)
    Path("swift.yaml").write_text("name: swift\nstages: [place: {}, domain: {}, ik: {}, search: {}, filter: {}]\n")
    assert words in cli("run", tmp_path / "c.yaml").error()


def test_options_that_a_job_of_a_config_lacks(cli, tmp_path):
    (tmp_path / "c.yaml").write_text("job: plan\nobject: tiny")
    assert "job 'plan' has no --rows; its keys: " in cli("run", tmp_path / "c.yaml", "-n", 5).error()


def test_jobs_have_the_names_and_defaults_of_their_commands(tmp_path):
    from lgrasp.jobs.config import load_requests

    def asked(text):
        (tmp_path / "c.yaml").write_text(text)
        return load_requests(str(tmp_path / "c.yaml"), {}).requests[0]

    plain = asked("job: sequence\nobjects: [mug, sphere]")
    assert (plain.pipeline.name, str(plain.out)) == ("sequence", "grasps/allegro-mug-sphere/sequence")
    other = "pipeline: sample\nseed: 7\npolicy: lookahead\nsettings: [bounds.friction=0.7]\nscale: 0.5\nout: x"
    chosen = asked(f"job: sequence\nobjects: [mug, sphere]\n{other}")
    assert (chosen.pipeline.name, chosen.pipeline.seed, chosen.pipeline.bounds.friction) == ("sample", 7, 0.7)
    assert (chosen.pipeline.sequence.policy, chosen.scale, str(chosen.out)) == ("lookahead", "0.5", "x")
    assert asked("job: simulate\nshards: [x]").protocol.name == "fc"
    assert asked("job: sample\nobjects: [mug, sphere]\nmodel: seq-allegro").pipeline.name == "sample"
    assert asked("job: policy\npipeline: swift").pipeline.name == "swift"


def test_shipped_configs(cli):
    from lgrasp.jobs.config import config_files, load_config, load_requests

    others = {"diffuser", "grasp"}  # of jobs that do not generate
    assert {"smoke", "table1"} | others <= set(config_files())
    assert all(load_requests(name, {}) if name in others else load_config(name) for name in config_files())
    assert "did you mean 'smoke'" in cli("run", "smok").error()


def test_bench(cli, tmp_path, quick, known_hands):
    base = ("bench", "--objects", "tiny", "--pipelines", quick, "-n", 10, "--repeat", 2, "--device", "cpu")
    result = cli(*base, "--json", tmp_path / "b.json")
    assert result.code == 0, result.err
    (cell,) = json.loads((tmp_path / "b.json").read_text())["cells"]
    (entry,) = cell["pipelines"].values()
    rate = entry["strict_valid_per_s"]
    assert 0 < rate["min"] <= rate["median"] <= rate["max"]
    assert entry["grasps"] == 10
    assert entry["build_seconds"]["field"] > 0
    assert "quick/s" in result.out
    assert [p.name for p in tmp_path.iterdir()] == ["b.json"]


@pytest.fixture
def table1(cli, quick, tmp_path_factory, known_hands):
    """table1(*more): two small cells."""
    slow = tmp_path_factory.mktemp("pipelines") / "slow.yaml"
    slow.write_text(Path(quick).read_text().replace("name: quick", "name: slow"))
    pair = f"{quick},{slow}"
    base = ("bench", "table1", "--objects", "tiny,capsule", "--pipelines", pair, "-n", 10, "--baseline-n", 1)
    base = (*base, "--hands", "allegro", "--repeat", 1, "--set", "search.restarts=3", "--device", "cpu")
    return lambda *more: cli(*base, *more)


def test_bench_table1(table1, monkeypatch, tmp_path, tmp_path_factory):
    """It is interrupted, goes on where it was, and has nothing left to do; --set reaches what is measured."""
    from lgrasp.bench import comparison

    measure = comparison.measure

    def stopped(jobs, *more):
        if jobs[0].object == "capsule":
            raise KeyboardInterrupt
        return measure(jobs, *more)

    scratch = tmp_path_factory.mktemp("scratch")
    with monkeypatch.context() as patch:
        patch.setattr(comparison, "measure", stopped)
        patch.setattr(tempfile, "tempdir", str(scratch))
        assert table1("--json", "t.json").code == 130
    assert not list(scratch.iterdir())
    kept = json.loads((tmp_path / "t.json").read_text())
    assert [cell["object"] for cell in kept["cells"]] == ["tiny"]
    assert not kept["complete"]
    assert [p.name for p in tmp_path.iterdir()] == ["t.json"]
    result = table1("--json", "t.json", "--resume", "--plot", "t.png")
    assert result.code == 0, result.err
    assert "tiny, " not in result.err
    assert "[2/2] allegro capsule: quick" in result.err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t.json", "t.png"]
    assert (tmp_path / "t.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    table = json.loads((tmp_path / "t.json").read_text())
    assert table["complete"]
    assert table["settings"]["set"] == ["search.restarts=3"]
    assert table["cells"][0] == kept["cells"][0]
    assert [cell["object"] for cell in table["cells"]] == ["tiny", "capsule"]
    for cell in table["cells"]:
        runs = cell["pipelines"]
        assert {name: run["grasps"] for name, run in runs.items()} == {"quick": 10, "slow": 1}
        rates = {name: run["strict_valid_per_s"]["median"] for name, run in runs.items()}
        assert cell["ratio"]["quick"] == rates["quick"] / rates["slow"]
        wanted = {"survivors", "seconds", "build_seconds", "near_duplicates", "distinct_poses", "published_count_per_s"}
        assert all(wanted <= set(run) for run in runs.values())
    tiny, capsule = table["cells"]
    assert tiny["published_per_s"] is None
    assert capsule["published_ratio"]["quick"] == rates["quick"] / 1296
    for text in ("\nmean ", "quick/slow", "Table 1", "A100", "survivors", "near-dup", "field s"):
        assert text in result.out
    again = table1("--json", "t.json", "--resume")
    assert again.code == 0
    assert "run 1/1" not in again.err
    assert again.out == result.out


def test_wrong_settings_of_a_bench_are_refused(cli):
    for command in ("table1", "sequence", "refine"):
        refused = cli("bench", command, "--set", "bounds.frction=1", "--device", "cpu")
        assert refused.code == 2
        assert "--set 'bounds.frction=1'" in refused.err


def test_bench_soak_needs_a_list_of_processes(cli, monkeypatch, tmp_path):
    monkeypatch.setattr("lgrasp.bench.soak.processes._LISTED", tmp_path / "proc")
    assert "which this system does not have" in cli("bench", "soak").error()


def test_bench_table1_refuses(cli):
    assert "come after its name" in cli("bench", "--device", "cpu", "table1").error()
    assert ".png" in cli("bench", "table1", "--plot", "t.pdf").error()
    assert "--json PATH" in cli("bench", "table1", "--resume").error()
    assert "hand_dir" in cli("bench", "table1", "--hand-dir", "absent", "--objects", "mug").error()
    result = cli("bench", "table1", "--objects", "plier", "--device", "cpu", "-n", 1)
    assert result.code == 2
    assert "object 'plier' is neither" in result.err


def test_warm_up(cli):
    count, rest = cli("warm-up", "--device", "cpu").out.split(" ", 1)
    assert int(count) > 20
    assert rest.startswith("modules ready on cpu")
