"""``lgrasp status``, ``dataset check`` and the Dataset on folders with a manifest."""

import json
import shutil
from pathlib import Path

import pytest
from support.fresh import SLOW, loaded
from support.jobs import SampleJob, StopAfter
from support.shards import sample_shard
from typer.testing import CliRunner

from lgrasp.dataset.manifest import ListedRun, ListedShard, Manifest
from lgrasp.dataset.status import folder_states
from lgrasp.dataset.torch_dataset import GraspDataset
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.events import Events
from lgrasp.engine.run import run
from lgrasp.errors import ShardError
from lgrasp_cli.main import app

AGAIN = "repeat the run's command, which keeps what is there"


def call(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def table(folder: Path, *more: str) -> list[list[str]]:
    """Cells of the lines of lgrasp status, folders relative to one."""
    lines = call("status", folder, *more).stdout.splitlines()[1:]
    return [[" ".join(cell.split()) for cell in line.replace(f"{folder}/", "").split("  ") if cell] for line in lines]


def test_states(tmp_path):
    run(SampleJob(out=tmp_path / "a" / "whole"))
    run(SampleJob(out=tmp_path / "a" / "cut"), StopAfter(1))
    run(SampleJob(out=tmp_path / "few", most=3))
    run(SampleJob(out=tmp_path / "two"))
    run(SampleJob(out=tmp_path / "two", rows=1, name="bowl"))
    shutil.copy(tmp_path / "two" / "toy-cup-00000.h5", tmp_path / "two" / "merged.h5")
    write_shard(tmp_path / "old" / "x.h5", sample_shard(2))
    run(SampleJob(out=tmp_path / "bad"))
    (tmp_path / "bad" / "manifest.json").write_text("{")
    run(SampleJob(out=tmp_path / "changed"))
    path = tmp_path / "changed" / "toy-cup-00001.h5"
    path.write_bytes(path.read_bytes()[:-1])
    assert table(tmp_path) == [
        ["a/cut", "sample toy cup seed 0", "2 of 6", "1 of 3", "incomplete", "repeat the same command"],
        ["a/whole", "sample toy cup seed 0", "6 of 6", "3 of 3", "complete"],
        ["bad", "-", "-", "3", "bad list", "the next run in the folder writes it again"],
        [
            "changed",
            "sample toy cup seed 0",
            "6 of 6",
            "3 of 3",
            "damaged",
            "remove the files, repeat the same command",
        ],
        ["few", "sample toy cup seed 0", "3 of 6", "3 of 3", "starved", "another pipeline or seed"],
        ["old", "-", "-", "1", "unlisted", "the next run in the folder lists them"],
        ["two", "sample toy bowl seed 0", "1 of 1", "1 of 1", "complete"],
        ["two", "sample toy cup seed 0", "6 of 6", "3 of 3", "complete"],
        ["two", "-", "-", "1", "foreign", "'lgrasp dataset info' says what they are"],
    ]
    (cut,) = json.loads(call("status", tmp_path / "a" / "cut", "--json", "-").stdout)
    assert cut["missing"] == ["toy-cup-00001.h5", "toy-cup-00002.h5"]
    assert (cut["rows"], cut["asked"], cut["shards"], cut["listed"], cut["state"]) == (2, 6, 1, 3, "incomplete")


def test_rows_of_shards_that_are_not_asked_for_any_more_count_as_asked(tmp_path):
    run(SampleJob(out=tmp_path))
    run(SampleJob(out=tmp_path, rows=2))
    ((_, run_, rows, shards, state),) = table(tmp_path)
    assert (run_, rows, shards, state) == ("sample toy cup seed 0", "6 of 6", "3 of 3", "complete")


def test_verify_reads_the_files(tmp_path):
    run(SampleJob(out=tmp_path))
    path = tmp_path / "toy-cup-00001.h5"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    assert folder_states([tmp_path])[0]["state"] == "complete"
    (found,) = folder_states([tmp_path], verify=True)
    assert found["state"] == "damaged"
    assert list(found["changed"]) == [path.name]


def test_running(tmp_path):
    class Look(Events):
        def advanced(self, part, done, *more):
            found.extend(folder_states([tmp_path]))

    found: list = []
    run(SampleJob(out=tmp_path, rows=2), Look())
    assert [(state["state"], len(state["workers"])) for state in found] == [("running", 1)]
    assert folder_states([tmp_path])[0]["state"] == "complete"


def test_nothing_there(tmp_path):
    for folder, why in ((tmp_path / "none", "no such folder"), (tmp_path, "no manifest.json and no shard")):
        with pytest.raises(ShardError, match=why):
            folder_states([folder])


def test_check(tmp_path, said):
    run(SampleJob(out=tmp_path))
    assert call("dataset", "check", tmp_path).stdout == "3 shards valid\n"
    shutil.move(tmp_path / "toy-cup-00000.h5", tmp_path / "other.h5")
    write_shard(tmp_path / "toy-cup-00001.h5", sample_shard(2, shard_index=1))
    result = call("dataset", "check", tmp_path)
    assert result.exit_code == 2
    missing, changed = sorted(result.stderr.splitlines())
    assert missing == f"{tmp_path / 'manifest.json'}: 1 of 3 shards are missing, first toy-cup-00000.h5; {AGAIN}"
    assert changed.startswith(f"{tmp_path / 'toy-cup-00001.h5'}: ")
    assert "manifest.json says" in changed
    assert said == [f"{tmp_path / 'manifest.json'}: 1 of the shards there are not listed, first other.h5"]
    (tmp_path / "manifest.json").write_text("[]")
    result = call("dataset", "check", tmp_path)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"{tmp_path / 'manifest.json'}: not a manifest of shards")


def test_a_folder_below_that_lost_all_its_shards(tmp_path, said):
    run(SampleJob(out=tmp_path / "a" / "lost"))
    run(SampleJob(out=tmp_path / "b"))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "manifest.json").write_text('{"name": "of a web page"}')
    for path in (tmp_path / "a" / "lost").glob("*.h5"):
        path.unlink()
    lost = f"{tmp_path}/a/lost/manifest.json: 3 of 3 shards are missing, first toy-cup-00000.h5; {AGAIN}"
    result = call("dataset", "check", tmp_path)
    assert (result.exit_code, result.stderr) == (2, f"{lost}\n")
    assert len(GraspDataset(tmp_path)) == 6
    assert said == [lost]


def test_what_a_folder_lost_of_scenes_or_is_being_made_in_it_is_not_told(tmp_path, said):
    """Copies that go into the folder of their sources are what the command makes."""
    run(SampleJob(out=tmp_path / "a"))
    copies = ("dataset", "metrics", tmp_path, "--add", "volume", "--out", tmp_path / "more")
    for _ in range(2):
        assert call(*copies).exit_code == 0
        for path in (tmp_path / "more").rglob("*.h5"):
            path.unlink()
    assert said == []
    shutil.rmtree(tmp_path / "more")
    lost = [ListedShard(shard_index=0, file="toy-scene-00000.h5", rows=1)]
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "manifest.json").write_text(
        Manifest(runs=[ListedRun(run_key="a", unit="scenes", shards=lost)]).model_dump_json()
    )
    assert call("dataset", "check", tmp_path).stdout == "3 shards valid\n"


def test_a_run_without_shards_is_nothing(tmp_path):
    """As another program may list it."""
    (tmp_path / "manifest.json").write_text(Manifest(runs=[ListedRun(run_key="a")]).model_dump_json())
    assert len(run(SampleJob(out=tmp_path)).written) == 3


def test_a_shard_that_came_after_the_manifest(tmp_path):
    """The disk was full when the manifest was to be written: the same job lists the shard, and does not make it."""
    run(SampleJob(out=tmp_path), StopAfter(2))
    before = (tmp_path / "manifest.json").read_bytes()
    run(SampleJob(out=tmp_path))
    (tmp_path / "manifest.json").write_bytes(before)
    how = f"1 of 3 shards are there but not listed as finished, first toy-cup-00002.h5; {AGAIN}"
    assert call("dataset", "check", tmp_path).stderr == f"{tmp_path / 'manifest.json'}: {how}\n"
    assert run(SampleJob(out=tmp_path)).written == []
    assert call("dataset", "check", tmp_path).stdout == "3 shards valid\n"


def test_dataset_says_what_is_missing(tmp_path, said):
    run(SampleJob(out=tmp_path))
    assert len(GraspDataset(tmp_path)) == 6
    assert said == []
    shutil.move(tmp_path / "toy-cup-00002.h5", tmp_path / "other.h5")
    for _ in range(2):
        assert len(GraspDataset(tmp_path)) == 6
    missing, foreign = said
    assert "1 of 3 shards are missing, first toy-cup-00002.h5" in missing
    assert "1 of the shards there are not listed, first other.h5" in foreign


def test_copies_say_what_is_missing(tmp_path, said):
    run(SampleJob(out=tmp_path / "all"))
    (tmp_path / "all" / "toy-cup-00002.h5").unlink()
    call("export", tmp_path / "all", "--to", "webdataset", "--out", tmp_path / "web")
    assert ["1 of 3 shards are missing" in line for line in said] == [True]


def test_status_loads_nothing_slow():
    assert loaded("import lgrasp_cli.status, lgrasp.dataset.status", [*SLOW, "warp"]) == []
