"""A run that was cut in any way ends with the bytes of an uninterrupted one."""

import fcntl
import shutil
import signal
import weakref
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.places import QUICK
from support.resumed import Child

from lgrasp.dataset.differences import compare
from lgrasp.dataset.manifest import read_manifest, workers
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine import shard as shard_module
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import Events
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.run import run as generate
from lgrasp.errors import ConfigError, OutputError
from lgrasp.jobs.generate import GenerateJob


def leftovers(folder):
    """What is neither a shard nor their list."""
    return [p.name for p in folder.iterdir() if p.suffix != ".h5" and p.name != "manifest.json"]


def listed(folder):
    """(name, rows) of the files in the manifest, whose hashes are those of the files."""
    manifest = read_manifest(folder / "manifest.json")
    assert manifest is not None
    assert compare(sorted(folder.glob("*.h5")), manifest).changed == {}
    return [(shard.file, shard.rows) for shard in manifest.shards]


@pytest.fixture
def warnings_of(cache_root):
    lines: list[str] = []
    return lines, Cache(cache_root, lines.append)


@pytest.fixture(scope="module")
def uninterrupted(small_job, tmp_path_factory):
    folder = tmp_path_factory.mktemp("uninterrupted")
    generate(GenerateJob(**small_job | {"rows": 60, "workers": 0, "batch": 0, "out": folder}))
    return folder


@pytest.fixture
def whole(uninterrupted, tmp_path):
    """Folder of an uninterrupted run of 60 rows in shards of 20."""
    return Path(shutil.copytree(uninterrupted, tmp_path / "whole"))


def test_deleted_shards_are_made_again(run, whole, raw_grasps):
    expected = raw_grasps(whole)
    kept = sorted(whole.glob("*.h5"))
    before = kept[1].stat().st_mtime_ns
    for shard in (0, 2):
        kept[shard].unlink()
    outcome = run(rows=60, out=whole)
    assert (outcome.rows, outcome.made, outcome.present) == (60, 40, 20)
    assert [p.name for p in outcome.written] == [kept[0].name, kept[2].name]
    assert kept[1].stat().st_mtime_ns == before
    assert raw_grasps(whole) == expected


def test_changed_files_are_told_where_they_are(job, whole):
    """Of a run with the same settings."""
    path, asked = min(whole.glob("*.h5")), job(rows=60, out=whole)
    assert asked.difference(path) == "what differs cannot be told"
    with h5py.File(path, "r+") as file:
        next(iter(file["objects"].values())).attrs["sha256"] = "0" * 64
        del file.attrs["text_sha256"]
    assert asked.difference(path) == "other contents of an object's file"
    with h5py.File(path, "r+") as file:
        file["hand/urdf"][()] = file["hand/urdf"].asstr()[()] + "\n"
    assert asked.difference(path) == "other contents of the hand's files and an object's file"


def test_nothing_to_do(run, whole):
    again = run(rows=60, out=whole)
    assert (again.made, again.present, again.rows) == (0, 60, 60)
    assert sorted(again.paths) == sorted(whole.glob("*.h5"))
    assert not again.written


def test_more_rows_later(run, whole, raw_grasps, tmp_path):
    """A last shard that was shorter is made anew, whole ones stay."""
    run(rows=30)
    outcome = run(rows=60)
    assert (outcome.present, outcome.made) == (30, 30)
    assert raw_grasps(tmp_path / "out") == raw_grasps(whole)


@pytest.fixture(scope="module")
def small_shards(small_job, tmp_path_factory):
    """Folder of seven shards of four rows."""
    folder = tmp_path_factory.mktemp("small")
    generate(GenerateJob(**small_job | {"rows": 28, "shard_rows": 4, "out": folder}))
    return folder


def test_damaged_shards(job, warnings_of, small_shards, raw_grasps, tmp_path):
    lines, cache = warnings_of
    out = Path(shutil.copytree(small_shards, tmp_path / "damaged"))
    whole, *paths = sorted(out.glob("*.h5"))
    before = whole.stat().st_mtime_ns
    for path, damage in zip(paths, ("truncated", "empty", "garbage", "header", "rows", "text"), strict=True):
        data = bytearray(path.read_bytes())
        if damage == "truncated":
            data = data[: len(data) // 2]
        elif damage == "empty":
            data = bytearray()
        elif damage == "garbage":
            data = bytearray(np.random.default_rng(0).bytes(len(data)))
        elif damage == "header":
            data[100:200] = bytes(100)
        elif damage == "rows":
            with h5py.File(path) as file:
                offset = file["grasps/q"].id.get_chunk_info(0).byte_offset
            data[offset + 5] ^= 0x40
        else:
            at = data.index(b"<robot")
            data[at + 1] ^= 1
        path.write_bytes(data)
    outcome = generate(job(rows=28, shard_rows=4, out=out, cache=cache))
    assert outcome.written == paths
    assert whole.stat().st_mtime_ns == before
    assert raw_grasps(out) == raw_grasps(small_shards)
    assert len(lines) == len(paths)
    for path in paths:
        (line,) = [line for line in lines if str(path) in line]
        assert "\n" not in line


def test_shard_of_another_run(run, swift, tmp_path):
    run(rows=20, shard_rows=10)
    other = swift.model_copy(update={"seed": 5})
    with pytest.raises(OutputError, match="another run"):
        run(rows=20, shard_rows=10, pipeline=other)
    with pytest.raises(OutputError, match="another run"):
        run(rows=20, shard_rows=5)
    sorted((tmp_path / "out").glob("*.h5"))[0].unlink()
    with pytest.raises(OutputError, match="another run"):  # its own shard 0 is free, the folder is not
        run(rows=10, shard_rows=10, pipeline=other)
    assert run(rows=20, shard_rows=10, pipeline=other, resume=False).made == 20


def test_a_run_that_found_nothing_does_not_block_its_folder(run, swift, raw_grasps, tmp_path):
    """A mistake in an option, and its correction with the same --out."""
    (path,) = run(pipeline=swift, rows=4, out=tmp_path / "out").paths
    shard = read_shard(path)
    write_shard(path, replace(shard, grasps=shard.grasps.select(np.zeros(4, bool))))
    other = {"pipeline": swift.with_seed(7), "rows": 4}
    assert run(**other, out=tmp_path / "out").made == 4
    run(**other, out=tmp_path / "alone")
    assert raw_grasps(tmp_path / "out") == raw_grasps(tmp_path / "alone")
    assert listed(tmp_path / "out") == [(path.name, 4)]


def test_other_objects_may_share_a_folder(run, tmp_path):
    run(rows=20)
    run(rows=20, object="sphere")
    assert len(list((tmp_path / "out").glob("*.h5"))) == 2


class TestStarving:
    """Bounded effort: what is found is kept, and history does not matter."""

    @pytest.fixture(scope="class", autouse=True)
    @classmethod
    def _short_effort(cls):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(shard_module, "_LEAST_EFFORT", 1024)
            yield

    @pytest.fixture(scope="class")
    @classmethod
    def poor(cls, swift):
        return swift.model_copy(update={"effort": 1, "patience": 1})

    @pytest.fixture(scope="class")
    @classmethod
    def starved(cls, small_job, poor, tmp_path_factory):
        """A run of two shards that gave up."""
        asked = {"rows": 2000, "shard_rows": 1000, "pipeline": poor, "out": tmp_path_factory.mktemp("starved")}
        return generate(GenerateJob(**small_job | asked))

    @pytest.fixture
    def hopeless(self, swift):
        return swift.with_params("search", least_force=0.5).model_copy(update={"effort": 1, "patience": 1})

    def test_starved_shards_are_present(self, run, starved, poor, raw_grasps, tmp_path):
        assert starved.starved
        assert len(starved.paths) == 2
        assert 0 < starved.made < 2000
        assert all(r.exhausted and r.candidates == 1024 for r in starved.results)
        shutil.copytree(starved.job.out, tmp_path / "out")
        again = run(rows=2000, shard_rows=1000, pipeline=poor)
        assert (again.made, again.rows, again.starved) == (0, starved.made, True)
        again.paths[1].unlink()
        again = run(rows=2000, shard_rows=1000, pipeline=poor)
        assert 0 < again.made < 1000
        assert raw_grasps(tmp_path / "out") == raw_grasps(starved.job.out)

    def test_more_effort_when_more_is_asked(self, run, poor, tmp_path):
        """A last shard that gave up early goes on when n, and with it the effort, grows."""
        first = run(rows=1000, shard_rows=4000, pipeline=poor)
        more = run(rows=4000, shard_rows=4000, pipeline=poor)
        assert first.starved
        assert more.starved
        assert more.results[0].candidates == 4096
        assert more.rows > first.rows

    def test_an_empty_shard_ends_the_run(self, run, hopeless, tmp_path):
        first = run(rows=3000, shard_rows=1000, pipeline=hopeless)
        assert (first.rows, first.starved, len(first.paths)) == (0, True, 1)
        again = run(rows=3000, shard_rows=1000, pipeline=hopeless)
        assert (again.rows, again.starved, len(again.paths), again.made) == (0, True, 1, 0)
        assert len(list((tmp_path / "out").glob("*.h5"))) == 1


def test_cancelled_run_keeps_whole_shards(job, whole, raw_grasps, tmp_path):
    class Stop(Events):
        asked = False

        def advanced(self, part, done, *more):
            self.asked = True

        def cancelled(self):
            return self.asked

    outcome = generate(job(rows=60), Stop())
    assert outcome.cancelled
    assert not outcome.starved
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["allegro-mug-00000.h5", "manifest.json"]
    generate(job(rows=60))
    assert raw_grasps(tmp_path / "out") == raw_grasps(whole)


def test_cancelled_before_the_first_batch(job, tmp_path):
    class Stop(Events):
        def cancelled(self):
            return True

    outcome = generate(job(), Stop())
    assert outcome.cancelled
    assert not (tmp_path / "out").exists()


def test_killed_while_writing(whole, raw_grasps, job, cache_root, tmp_path):
    out = tmp_path / "killed"
    assert Child(out, cache_root, 60, dies=True).finish() == -signal.SIGKILL
    left, mark = sorted(leftovers(out))
    assert left.endswith(".h5.tmp")
    assert mark.endswith(".running.tmp")
    assert workers(out) == []
    assert [rows for _, rows in listed(out)] == [20, None, None]
    assert len(list(out.glob("*.h5"))) == 1
    held = out / "allegro-mug-00002.0123456789ab.h5.tmp"  # another process is writing this one
    foreign = out / "notes.tmp"
    foreign.touch()
    with open(held, "wb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        generate(job(rows=60, out=out))
        assert sorted(leftovers(out)) == sorted([held.name, foreign.name])
    generate(job(rows=60, out=out))
    assert leftovers(out) == [foreign.name]
    assert raw_grasps(out) == raw_grasps(whole)
    assert listed(out) == listed(whole)


def test_processes_share_an_empty_cache(whole, raw_grasps, tmp_path):
    out, cache = tmp_path / "array", tmp_path / "cache"
    children = [Child(out, cache, 60, task=(task, 2)) for task in range(2)]
    assert [child.finish() for child in children] == [0, 0]
    assert raw_grasps(out) == raw_grasps(whole)
    assert not leftovers(out)
    assert listed(out) == listed(whole)
    assert sorted(p.parent.name for p in cache.rglob("*") if p.is_file()) == ["field", "hand", "object"]


def test_full_disk(job, raw_grasps, tmp_path):
    """A limit on the size of files stands for the full disk."""
    resource = pytest.importorskip("resource")
    out = tmp_path / "out"
    generate(job(rows=20))
    before = raw_grasps(out)
    size = next(out.glob("*.h5")).stat().st_size
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    for limit in (0, size // 2):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
        try:
            with pytest.raises(OutputError) as caught:
                generate(job(rows=40))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert "\n" not in str(caught.value)
        assert raw_grasps(out) == before
        assert not leftovers(out)
    assert generate(job(rows=40)).made == 20


def test_output_folder_that_cannot_be_made(job, tmp_path):
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match="is a file"):
            generate(job(out=out))
    with pytest.raises(OutputError, match="cannot be written"):
        generate(job(out=Path("/proc/lgrasp")))


def test_bad_input_leaves_no_folder(job, tmp_path):
    bad = tmp_path / "bad.obj"
    bad.write_text("v 0 0 0\n")
    with pytest.raises(Exception, match=r"bad\.obj"):
        generate(job(object=str(bad)))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "changes",
    [
        {"rows": 0},
        {"rows": -5},
        {"shard_rows": 0},
        {"array": (0, 0)},
        {"array": (1, 1)},
        {"array": (-1, 2)},
        {"workers": -1},
        {"batch": -1},
    ],
)
def test_numbers_out_of_range(run, changes):
    with pytest.raises(ConfigError) as caught:
        run(**changes)
    assert "\n" not in str(caught.value)


def test_task_without_a_shard(run, tmp_path):
    outcome = run(rows=20, array=(3, 4))
    assert (outcome.paths, outcome.rows, outcome.starved) == ([], 0, False)
    assert not (tmp_path / "out").exists()


def test_long_names(run, tmp_path):
    from lgrasp.object.find import find_object

    mesh = tmp_path / f"{'x' * 240}.obj"
    mesh.write_bytes(find_object("sphere").read_bytes())
    assert run(rows=20, object=str(mesh), pipeline=load_pipeline(QUICK)).paths[0].is_file()


def test_memory_does_not_grow_with_the_shards(job):
    class Watch(Events):
        def __init__(self):
            self.tables = []
            self.alive = []

        def wrote(self, part, made):
            self.tables.append(weakref.ref(made.contents))
            self.alive.append(sum(table() is not None for table in self.tables))

    watch = Watch()
    outcome = generate(job(rows=60), watch)
    assert outcome.rows == 60
    assert watch.alive == [1] * 3
    assert sum(len(r.grasps) for r in outcome.results) == 0
