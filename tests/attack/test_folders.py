"""Folders in which files are damaged, missing or in each other's place: what can be used is, the rest is said."""

import os
import shutil
from dataclasses import replace

import h5py
import pytest
from support.jaws import jaw_rows, jaw_shard

from lgrasp.dataset.files import check_heaps, sha256
from lgrasp.dataset.manifest import read_manifest
from lgrasp.dataset.reader import open_hdf5
from lgrasp.dataset.scenes import SceneRows
from lgrasp.dataset.status import folder_states
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import JobOutcome
from lgrasp.engine.run import run as run_job
from lgrasp.errors import HandError, ShardError
from lgrasp.hand.urdf import read_robot
from lgrasp.jobs.metrics import MetricsJob
from lgrasp.judge.bounds import JudgeError
from lgrasp.judge.run import judge
from lgrasp.runtime.array import Array


@pytest.fixture
def folder(tmp_path):
    """A shard of four rows; one with a damaged column; one that is no shard; a link that leads nowhere; a loop."""
    (tmp_path / "urdf").mkdir()
    shards = tmp_path / "shards"
    shard = jaw_shard(tmp_path / "urdf", jaw_rows(0.002, count=4))
    for number in (0, 1):
        write_shard(shards / f"{number}.h5", replace(shard, header=replace(shard.header, shard_index=number)))
    with h5py.File(shards / "1.h5") as file:
        chunk = file["grasps/q"].id.get_chunk_info(0)
    with open(shards / "1.h5", "r+b") as file:
        file.seek(chunk.byte_offset)
        file.write(b"\xff" * chunk.size)
    (shards / "2.h5").write_bytes(b"no shard")
    (shards / "3.h5").symlink_to("nowhere")
    (shards / "loop").symlink_to(".")
    return shards


def test_what_is_damaged_is_not_drawn(folder, said):
    rows = SceneRows([folder, folder])
    assert [path.name for path in rows.files] == ["0.h5", "1.h5"]
    assert rows.sound(range(len(rows))) == [0, 1, 2, 3]
    assert rows.sound(range(2, 8), most=1) == [2]
    assert [line.partition(": ")[0] for line in said] == [
        f"2 of 4 files are left out, first {folder / '2.h5'}",
        str(folder / "1.h5"),
    ]
    for asked in ([5], range(4, 8)):
        with pytest.raises(ShardError, match=r"1\.h5: .*damaged"):
            rows.sound(asked)
    with pytest.raises(ShardError, match=r"2\.h5: "):  # it was named
        SceneRows([folder / "0.h5", folder / "2.h5"])


def test_tasks_of_an_array_read_the_rows_of_their_own_shards(folder, said, cache_root, tmp_path):
    def task(number: int, tasks: int, **lane: int) -> JobOutcome:
        given = {"add": ("volume",), "out": tmp_path / f"{tasks}", "device": "cpu", "cache": Cache(cache_root)}
        return run_job(MetricsJob(shards=(folder,), **given), array=Array(number, tasks, **lane))

    assert [path.name for path in task(0, 2).paths] == ["0.h5"]
    with pytest.raises(ShardError, match=r"1\.h5: .*damaged"):
        task(1, 2)
    assert not task(1, 2, lanes=2).paths  # devices side by side: the others may have more
    assert said.pop().startswith(f"1 of 1 files are left out, first {folder / '1.h5'}: ")
    assert {line.partition(": ")[0] for line in said} == {f"2 of 4 files are left out, first {folder / '2.h5'}"}
    said.clear()
    assert [path.name for path in task(0, 1).paths] == ["0.h5"]
    assert said[-1].startswith(f"1 of 2 files are left out, first {folder / '1.h5'}: ")
    assert [shard.file for shard in read_manifest(tmp_path / "1" / "manifest.json").shards] == ["0.h5"]


def test_a_shard_in_the_place_of_another(run, raw_grasps, cache_root, tmp_path):
    run(rows=8, shard_rows=4)
    out = tmp_path / "out"
    whole = raw_grasps(out)
    first, second = sorted(out.glob("*.h5"))
    shutil.copy(first, second)
    said: list[str] = []
    again = run(rows=8, shard_rows=4, cache=Cache(cache_root, said.append))
    assert (again.made, again.present) == (4, 4)
    assert said == [f"{second} holds shard 0, not 1; rebuilding it"]
    assert raw_grasps(out) == whole


def test_states_of_files_that_cannot_be_read(run, tmp_path):
    run(rows=8, shard_rows=4)
    first, _ = sorted((tmp_path / "out").glob("*.h5"))
    first.unlink()
    first.symlink_to("nowhere")
    (state,) = folder_states([tmp_path])
    assert state["state"] == "damaged"
    assert state["changed"] == {first.name: "it cannot be read: No such file or directory"}


def test_pipes_are_not_waited_for(folder, said):
    os.mkfifo(folder / "4.h5")
    assert [path.name for path in SceneRows(folder).files] == ["0.h5", "1.h5"]
    for read, refused in (
        (SceneRows, ShardError),
        (check_heaps, ShardError),
        (sha256, ShardError),
        (open_hdf5, ShardError),
        (judge, JudgeError),
        (read_robot, HandError),
    ):
        with pytest.raises(refused, match=r"4\.h5.*no regular file"):
            read(folder / "4.h5")


def test_a_mesh_of_no_object_is_not_ignored(folder, tmp_path):
    (tmp_path / "box.obj").touch()
    with pytest.raises(JudgeError, match="mesh of object 'other': the shards hold cube"):
        judge(folder / "0.h5", mesh={"other": tmp_path / "box.obj"})
