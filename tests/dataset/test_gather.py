"""Which shards a command works on: a folder may hold folders, files that cannot be used, and the same rows twice."""

import os
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
from support.shards import sample_shard

from lgrasp import notices
from lgrasp.dataset.differences import check_files
from lgrasp.dataset.gather import gather
from lgrasp.dataset.info import describe
from lgrasp.dataset.merge import merge_shards
from lgrasp.dataset.status import folder_states
from lgrasp.dataset.torch_dataset import GraspDataset
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import ShardError
from lgrasp.grasp.schema import MADE_FROM
from lgrasp.judge.bounds import JudgeError
from lgrasp.judge.files import find_shards as judged_files


def write(path, index, run="a", rows=3, **statistics):
    shard = sample_shard(rows, shard_index=index)
    shard = replace(shard, header=replace(shard.header, config={"run_key": run}), statistics=statistics)
    write_shard(path, shard)
    return path


def test_folders_of_folders(tmp_path, said):
    one = write(tmp_path / "top" / "mug" / "robust" / "0.h5", 0)
    two = write(tmp_path / "top" / "bowl" / "robust" / "0.h5", 0, "b")
    assert [str(shard.place) for shard in gather(tmp_path / "top")] == ["bowl/robust/0.h5", "mug/robust/0.h5"]
    assert [shard.path for shard in gather([one, one, tmp_path / "top"])] == [one, two]
    assert len(GraspDataset(tmp_path / "top")) == 6
    assert said == []


def test_in_python_what_is_left_out_is_a_warning(tmp_path, monkeypatch):
    write(tmp_path / "0.h5", 0)
    cut = write(tmp_path / "1.h5", 1)
    cut.write_bytes(cut.read_bytes()[:-50])
    monkeypatch.setattr(notices, "_listeners", [])
    for _ in range(2):
        with pytest.warns(UserWarning, match=r"1 of 2 files are left out, first .*1\.h5"):
            assert len(GraspDataset(tmp_path)) == 3


def test_a_shard_that_the_program_has_open_is_read(tmp_path):
    path = write(tmp_path / "0.h5", 0)
    with h5py.File(path) as file:
        assert len(GraspDataset(tmp_path)) == len(file["grasps/q"]) == 3


def test_links_to_folders_are_followed_once(tmp_path):
    inside = write(tmp_path / "top" / "mug" / "0.h5", 0)
    outside = write(tmp_path / "disk" / "bowl" / "0.h5", 1)
    for link, to in (("a", "top/mug"), ("b", "disk"), ("c", "."), ("mug/d", "disk"), ("../disk/e", "disk")):
        (tmp_path / "top" / link).symlink_to(tmp_path / to)
    found = [shard.path for shard in gather(tmp_path / "top")]
    assert found == [tmp_path / "top" / "b" / "bowl" / "0.h5", inside]
    assert found[0].samefile(outside)
    assert {Path(state["folder"]) for state in folder_states([tmp_path / "top"])} == {path.parent for path in found}


def test_folders_that_cannot_be_read_are_told(tmp_path, said, monkeypatch):
    """A check does not pass on what it did not see."""
    write(tmp_path / "top" / "mug" / "0.h5", 0)
    closed = write(tmp_path / "top" / "bowl" / "0.h5", 1).parent
    scan = os.scandir

    def refuse(path):
        if Path(path) == closed:
            raise PermissionError(13, "Permission denied", str(path))
        return scan(path)

    monkeypatch.setattr(os, "scandir", refuse)
    assert [shard.path.parent.name for shard in gather(tmp_path / "top")] == ["mug"]
    assert said == [f"folder {closed} is left out: Permission denied"]
    assert check_files(tmp_path / "top", lambda path: [])[str(closed)] == ["Permission denied"]
    assert check_files(tmp_path / "top" / "mug" / "0.h5", lambda path: []) == {
        str(tmp_path / "top" / "mug" / "0.h5"): []
    }
    with pytest.raises(JudgeError, match="bowl: Permission denied"):
        judged_files([tmp_path / "top"])


def test_what_cannot_be_used_is_left_out(tmp_path, said):
    good = write(tmp_path / "top" / "a" / "0.h5", 0)
    cut = write(tmp_path / "top" / "a" / "1.h5", 1)
    cut.write_bytes(cut.read_bytes()[:-50])
    (tmp_path / "top" / "notes.h5").write_text("no shard")
    assert [shard["file"] for shard in describe(tmp_path / "top")] == [str(good)]
    (line,) = said
    assert line.startswith(f"2 of 3 files are left out, first {cut}: ")
    for named in (cut, [good, cut]):
        with pytest.raises(ShardError, match=r"a/1\.h5"):
            describe(named)
    good.unlink()
    with pytest.raises(ShardError, match=r"a/1\.h5"):
        describe(tmp_path / "top")


def test_a_merged_file_and_its_sources_count_once(tmp_path, said):
    """Of a merged file with all of its sources these are taken, with some of them the merged file."""
    sources = [write(tmp_path / "all" / "x" / f"{index}.h5", index) for index in range(3)]
    whole, pair, one = (tmp_path / "all" / name for name in ("merged.h5", "x/pair.h5", "one.h5"))
    for number, path in ((3, whole), (2, pair), (1, one)):
        merge_shards(sources[:number], path)
    assert [shard.path for shard in gather(tmp_path / "all")] == sources
    assert len(GraspDataset(tmp_path / "all")) == 9
    assert "3 of 6 shards repeat rows of others and are left out" in said[0]
    for path in (pair, one, sources[0], sources[1]):
        path.unlink()
    assert [shard.path for shard in gather(tmp_path / "all")] == [whole]
    assert [shard.path for shard in gather([whole, *sources[2:]])] == [whole, sources[2]]  # as named


def test_the_same_rows_count_once(tmp_path, said):
    source = write(tmp_path / "top" / "x" / "0.h5", 0)
    refined = write(tmp_path / "top" / "a-refined" / "0.h5", 0, **{MADE_FROM: "some job"})
    other = write(tmp_path / "top" / "x" / "1.h5", 1)
    assert [shard.path for shard in gather(tmp_path / "top")] == [source, other]
    assert said == [f"1 of 3 shards repeat rows of others and are left out, first {refined} (rows of {source})"]
    assert [shard.path for shard in gather([refined, tmp_path / "top" / "x"])] == [refined, source, other]


def test_of_fewer_and_more_rows_of_a_run_the_more_count(tmp_path):
    """As they are generated: what was made from rows may have more of them only if some were made anew."""
    few, many = (write(tmp_path / "top" / name / "0.h5", 0, rows=rows) for name, rows in (("a", 3), ("b", 5)))
    write(tmp_path / "top" / "c" / "0.h5", 0, rows=6, **{MADE_FROM: "some job"})
    assert [shard.path for shard in gather(tmp_path / "top")] == [many]
    assert [shard.path for shard in gather([few, tmp_path / "top"])] == [few, many]
