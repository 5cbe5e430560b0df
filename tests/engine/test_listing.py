"""``manifest.json`` of a run: what was asked and what is there, whatever happened on the way."""

import gc
import hashlib
import json
import os
import shutil
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import pytest
from support.jobs import SampleJob, StopAfter
from support.shards import sample_shard

from lgrasp.dataset.differences import compare
from lgrasp.dataset.manifest import read_manifest, update_manifest, workers
from lgrasp.dataset.merge import merge_shards
from lgrasp.dataset.writer import write_shard
from lgrasp.engine import listing
from lgrasp.engine.events import CancelledError, Events
from lgrasp.engine.listing import Renewing
from lgrasp.engine.run import run
from lgrasp.errors import OutputError, ShardError


def document(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "manifest.json").read_text())


def entries(folder: Path) -> list[tuple[int | None, int | None]]:
    """(asked, rows) of every file, in order."""
    return [(s.get("asked"), s.get("rows")) for r in document(folder)["runs"] for s in r["shards"]]


def differences(folder: Path):
    manifest = read_manifest(folder / "manifest.json")
    assert manifest is not None
    return compare(sorted(folder.glob("*.h5")), manifest)


def test_what_a_manifest_says(tmp_path):
    run(SampleJob(out=tmp_path, rows=5))
    (found,) = document(tmp_path)["runs"]
    shards = found.pop("shards")
    assert found.pop("run_key") == SampleJob(out=tmp_path).key()
    assert found.pop("lgrasp_version")
    assert found == {"job": "sample", "unit": "grasps", "hand": "toy", "objects": ["cup"], "seed": 0}
    assert [(s["file"], s["shard_index"], s["asked"], s["rows"]) for s in shards] == [
        ("toy-cup-00000.h5", 0, 2, 2),
        ("toy-cup-00001.h5", 1, 2, 2),
        ("toy-cup-00002.h5", 2, 1, 1),
    ]
    for shard in shards:
        data = (tmp_path / shard["file"]).read_bytes()
        assert (shard["bytes"], shard["sha256"]) == (len(data), hashlib.sha256(data).hexdigest())


def test_a_cut_run_lists_what_is_missing_and_ends_like_a_whole_one(tmp_path):
    run(SampleJob(out=tmp_path / "whole"))
    run(SampleJob(out=tmp_path / "cut"), StopAfter(1))
    assert entries(tmp_path / "cut") == [(2, 2), (2, None), (2, None)]
    assert differences(tmp_path / "cut").missing == ["toy-cup-00001.h5", "toy-cup-00002.h5"]
    run(SampleJob(out=tmp_path / "cut"))
    whole, cut = (tmp_path / name / "manifest.json" for name in ("whole", "cut"))
    assert cut.read_bytes() == whole.read_bytes()
    before = cut.stat().st_mtime_ns
    run(SampleJob(out=tmp_path / "cut"))
    assert cut.stat().st_mtime_ns == before


def test_a_manifest_that_was_removed_meanwhile_lists_again_what_is_asked(tmp_path):
    class Removing(SampleJob):
        def make(self, part, progress):
            if part.number == 1:
                while entries(self.out)[0] == (2, None):
                    time.sleep(0.01)
                (self.out / "manifest.json").unlink()
            return super().make(part, progress)

    run(Removing(out=tmp_path), StopAfter(2))
    assert entries(tmp_path) == [(2, 2), (2, 2), (2, None)]
    assert len(document(tmp_path)["runs"]) == 1
    assert differences(tmp_path).missing == ["toy-cup-00002.h5"]


def test_what_another_task_has_dropped_stays_dropped(tmp_path):
    """An input is found damaged by the task that has it, which begins while another works."""

    class Losing(SampleJob):
        def whole(self, parts, *, some):
            return [part for part in parts if part.number != 2]

    class First(Losing):
        def make(self, part, progress):
            if part.number == 1:
                run(Losing(out=self.out, rows=8), array=(0, 2))
            return super().make(part, progress)

    run(First(out=tmp_path, rows=8), array=(1, 2))
    assert differences(tmp_path).missing == []
    assert entries(tmp_path) == [(2, 2)] * 3


def test_of_two_runs_side_by_side_each_file_is_listed_as_it_is(tmp_path):
    """The second makes the first's files again once these are listed, and ends before it."""

    class Another(SampleJob):
        def make(self, part, progress):
            made = super().make(part, progress)
            if part.number == 2:
                run(Second(out=tmp_path), resume=False)
            return made

    class Second(SampleJob):
        def make(self, part, progress):
            made = super().make(part, progress)
            header = replace(made.contents.header, created="2027-01-02T03:04:05+00:00")
            return replace(made, contents=replace(made.contents, header=header))

    run(Another(out=tmp_path))
    found = differences(tmp_path)
    assert not found.missing + found.foreign
    assert not found.changed
    for shard in document(tmp_path)["runs"][0]["shards"]:
        assert hashlib.sha256((tmp_path / shard["file"]).read_bytes()).hexdigest() == shard["sha256"]


@pytest.mark.parametrize("rows", [6, 5])
def test_whole_parts_made_beside_one_that_is_stopped_stay(tmp_path, rows):
    """What becomes of one that falls short depends on those before it: it is made again."""
    made = threading.Event()

    class SideBySide(SampleJob):
        def at_once(self):
            return 2

        def make(self, part, progress):
            if part.number == 1:  # the first is made alone
                assert made.wait(60)
                raise CancelledError
            try:
                return super().make(part, progress)
            finally:
                if part.number == 2:
                    made.set()

    assert run(SideBySide(out=tmp_path / "cut", most=rows)).cancelled
    assert entries(tmp_path / "cut") == [(2, 2), (2, None), (2, 2 if rows == 6 else None)]
    for name in ("whole", "cut"):
        run(SampleJob(out=tmp_path / name, most=rows))
    whole, cut = (tmp_path / name / "manifest.json" for name in ("whole", "cut"))
    assert cut.read_bytes() == whole.read_bytes()


def test_nothing_made_leaves_nothing(tmp_path):
    assert run(SampleJob(out=tmp_path / "a" / "b"), StopAfter(0)).cancelled
    assert list(tmp_path.iterdir()) == []


def test_more_and_fewer_rows_later(tmp_path):
    run(SampleJob(out=tmp_path, rows=3))
    assert entries(tmp_path) == [(2, 2), (1, 1)]
    run(SampleJob(out=tmp_path, rows=8), StopAfter(0))
    assert entries(tmp_path) == [(2, 2), (2, None), (2, None), (2, None)]
    run(SampleJob(out=tmp_path, rows=8))
    assert entries(tmp_path) == [(2, 2)] * 4
    run(SampleJob(out=tmp_path, rows=3))  # what is there stays
    assert entries(tmp_path) == [(2, 2), (1, 2), (None, 2), (None, 2)]
    assert differences(tmp_path) == ([], {}, [], 4, [])


def test_runs_of_one_folder(tmp_path):
    """Each has its files; of a run that is replaced none is left, and nothing goes before there is something new."""
    run(SampleJob(out=tmp_path, rows=4))
    run(SampleJob(out=tmp_path, rows=2, name="bowl"))
    assert [(r["objects"], len(r["shards"])) for r in document(tmp_path)["runs"]] == [(["bowl"], 1), (["cup"], 2)]
    other = SampleJob(out=tmp_path, rows=2, seed=1)
    run(other, StopAfter(0), resume=False)
    assert len(list(tmp_path.glob("*.h5"))) == 3
    run(other, resume=False)
    assert [(r["objects"], r["seed"], len(r["shards"])) for r in document(tmp_path)["runs"]] == [
        (["bowl"], 0, 1),
        (["cup"], 1, 1),
    ]
    assert differences(tmp_path) == ([], {}, [], 2, [])


def test_tasks_that_replace_a_run_keep_what_others_made(tmp_path):
    """The task with the first file removes what is left; files of the run itself stay, also those beyond its rows."""
    run(SampleJob(out=tmp_path, rows=12))
    for rows, task in ((10, 1), (6, 1), (6, 0)):
        run(SampleJob(out=tmp_path, rows=rows, seed=1), array=(task, 2), resume=False)
    names = [f"toy-cup-{n:05d}.h5" for n in (0, 1, 2, 3)]
    assert sorted(path.name for path in tmp_path.glob("*.h5")) == names
    assert differences(tmp_path) == ([], {}, [], 4, [])


def test_a_run_that_finds_no_more_is_not_incomplete(tmp_path):
    run(SampleJob(out=tmp_path, rows=9, most=3))
    assert entries(tmp_path) == [(2, 2), (2, 1), (2, 0), (2, 0), (1, 0)]
    assert differences(tmp_path) == ([], {}, [], 5, [])
    assert len(list(tmp_path.glob("*.h5"))) == 3
    before = (tmp_path / "manifest.json").read_bytes()
    run(SampleJob(out=tmp_path, rows=9, most=3))
    assert (tmp_path / "manifest.json").read_bytes() == before


def test_files_that_came_before_the_manifest_belong(tmp_path):
    run(SampleJob(out=tmp_path, rows=4))
    run(SampleJob(out=tmp_path, rows=2, name="bowl"))
    (tmp_path / "manifest.json").unlink()
    run(SampleJob(out=tmp_path, rows=6))
    assert [(r["job"], len(r["shards"])) for r in document(tmp_path)["runs"]] == [("", 1), ("sample", 3)]
    assert differences(tmp_path) == ([], {}, [], 4, [])
    run(SampleJob(out=tmp_path, rows=2, name="bowl"))
    assert [r["job"] for r in document(tmp_path)["runs"]] == ["sample", "sample"]


@pytest.mark.parametrize("damage", [b"", b'{"format": "lgrasp-manifest", "runs": 3}'])
def test_a_damaged_manifest_is_said_and_written_again(tmp_path, damage, said):
    run(SampleJob(out=tmp_path))
    whole = (tmp_path / "manifest.json").read_bytes()
    (tmp_path / "manifest.json").write_bytes(damage)
    run(SampleJob(out=tmp_path))
    assert (tmp_path / "manifest.json").read_bytes() == whole
    assert [line.endswith("writing it again") for line in said] == [True] * bool(damage)


def test_manifest_that_is_no_file(tmp_path):
    (tmp_path / "manifest.json").mkdir()
    with pytest.raises(OutputError, match=r"manifest\.json: it is no file; remove it"):
        run(SampleJob(out=tmp_path))


def test_missing_changed_and_foreign_shards_in_a_merge(tmp_path, said):
    folder, out = tmp_path / "run", tmp_path / "all.h5"
    run(SampleJob(out=folder), StopAfter(2))
    with pytest.raises(ShardError, match=r"1 of 3 shards are missing, first toy-cup-00002\.h5; .*--partial"):
        merge_shards(folder, out)
    assert not out.exists()
    assert merge_shards(folder, out, partial=True) == 4
    assert "what is there is merged" in said[-1]
    run(SampleJob(out=folder))
    shutil.copy(folder / "toy-cup-00002.h5", tmp_path / "kept.h5")
    write_shard(folder / "toy-cup-00002.h5", sample_shard(2, shard_index=2))
    for partial in (False, True):
        with pytest.raises(ShardError, match=r"toy-cup-00002\.h5: .*manifest\.json says"):
            merge_shards(folder, out, partial=partial)
    shutil.copy(tmp_path / "kept.h5", folder / "toy-cup-00002.h5")
    run(SampleJob(out=tmp_path / "more", rows=8))
    shutil.copy(tmp_path / "more" / "toy-cup-00003.h5", folder / "found.h5")
    assert merge_shards(folder, out) == 8
    assert "1 of the shards there are not listed, first found.h5" in said[-1]


@pytest.mark.parametrize("resume", [True, False])
def test_a_run_in_a_folder_where_another_is_at_work(tmp_path, resume):
    """The later one ends before it takes a file, though none was there when it began."""
    begun, go_on = threading.Event(), threading.Event()

    class Slow(SampleJob):
        def make(self, part, progress):
            begun.set()
            assert go_on.wait(60)
            return super().make(part, progress)

    class Later(SampleJob):
        def load(self, events, missing):
            assert begun.wait(60)

    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(run, Slow(out=tmp_path))
        with pytest.raises(OutputError, match=r"toy-cup-00000.h5 is being made by another run; wait for it, or choose"):
            run(Later(out=tmp_path, seed=1), resume=resume)
        go_on.set()
        assert len(first.result().written) == 3
    assert [(r["seed"], len(r["shards"])) for r in document(tmp_path)["runs"]] == [(0, 3)]
    assert differences(tmp_path) == ([], {}, [], 3, [])


def test_a_run_whose_files_came_while_it_loaded(tmp_path):
    class Later(SampleJob):
        def load(self, events, missing):
            run(SampleJob(out=tmp_path))

    with pytest.raises(OutputError, match=r"toy-cup-00000.h5 belongs to another run"):
        run(Later(out=tmp_path, seed=1))
    assert [r["seed"] for r in document(tmp_path)["runs"]] == [0]


def test_tasks_that_write_at_once(tmp_path):
    """Nothing that one of four tasks lists is lost."""
    whole, out = tmp_path / "whole", tmp_path / "out"
    run(SampleJob(out=whole, rows=24))
    with ThreadPoolExecutor(4) as pool:
        jobs = [pool.submit(run, SampleJob(out=out, rows=24), array=(task, 4)) for task in range(4)]
        assert [len(job.result().written) for job in jobs] == [3] * 4
    assert (out / "manifest.json").read_bytes() == (whole / "manifest.json").read_bytes()
    assert {path.suffix for path in out.iterdir()} == {".h5", ".json"}


def test_two_processes_that_renew_a_file(tmp_path):
    """What the later one writes is listed, though the earlier one listed a file of the same size."""
    run(SampleJob(out=tmp_path, rows=2))
    (part,) = SampleJob(out=tmp_path, rows=2).parts()
    with Renewing([part]).kept({}) as first, Renewing([part]).kept({}) as second:
        for number, process in enumerate((first, second)):
            data = part.file.read_bytes()
            part.file.write_bytes(data[:-1] + bytes([number]))
            process.record(part, 2, written=True)
    (shard,) = document(tmp_path)["runs"][0]["shards"]
    assert shard["sha256"] == hashlib.sha256(part.file.read_bytes()).hexdigest()


def test_many_files_are_renewed_in_few_manifests(tmp_path, monkeypatch):
    """Manifests grow with the files: writing one for each took most of the time of thousands."""
    run(SampleJob(out=tmp_path, rows=40))
    parts = SampleJob(out=tmp_path, rows=40).parts()
    before = (tmp_path / "manifest.json").read_bytes()
    written = []

    def slow(folder, change):
        written.append(folder)
        time.sleep(0.02)
        update_manifest(folder, change)

    monkeypatch.setattr(listing, "update_manifest", slow)
    with Renewing(parts).kept({}) as renewing:
        for part in parts:
            renewing.record(part, 2, written=True)
    assert len(written) < 6
    assert (tmp_path / "manifest.json").read_bytes() == before


@pytest.mark.parametrize("in_place", [False, True])
def test_a_finished_job_is_gone_at_once(tmp_path, in_place):
    """What it holds of objects, tens of MB, does not wait until Python looks for circles."""

    class Replacing(SampleJob):
        in_place: ClassVar[bool] = True

    job = (Replacing if in_place else SampleJob)(out=tmp_path, rows=4)
    gc.disable()
    try:
        run(job, resume=False)
        seen = weakref.ref(job)
        del job
        assert seen() is None
    finally:
        gc.enable()


def test_a_working_process_is_seen(tmp_path):
    class Look(Events):
        def advanced(self, part, done, *more):
            found.extend(workers(tmp_path))

    found: list = []
    run(SampleJob(out=tmp_path, rows=2), Look())
    assert [(worker.run_key, worker.pid) for worker in found] == [(SampleJob(out=tmp_path).key(), os.getpid())]
    assert workers(tmp_path) == []
