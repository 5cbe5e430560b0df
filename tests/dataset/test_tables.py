"""Rows of objects on a table in shards."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from support.shards import sample_on_table

from lgrasp.dataset.merge import merge_shards
from lgrasp.dataset.reader import ShardReader, read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import ShardError


def test_what_is_written_is_read(tmp_path, same_rows):
    shard = sample_on_table()
    write_shard(tmp_path / "s.h5", shard)
    assert validate_shard(tmp_path / "s.h5") == []
    back = read_shard(tmp_path / "s.h5")
    same_rows(shard.grasps, back.grasps)
    np.testing.assert_array_equal(back.objects[0].tables, shard.objects[0].tables)
    with ShardReader(tmp_path / "s.h5") as reader:
        np.testing.assert_array_equal(reader.column("table/approach", 1, 3), shard.grasps.table["approach"][1:3])


def test_merged(tmp_path, same_rows):
    parts = [sample_on_table(3, shard_index=index) for index in (0, 1)]
    for index, part in enumerate(parts):
        write_shard(tmp_path / "run" / f"{index}.h5", part)
    merge_shards(tmp_path / "run", tmp_path / "all.h5")
    assert validate_shard(tmp_path / "all.h5") == []
    merged = read_shard(tmp_path / "all.h5")
    joined = np.concatenate([part.grasps.table["pose"] for part in parts])
    np.testing.assert_array_equal(merged.grasps.table["pose"], joined)
    assert merged.objects[0].tables is not None


@pytest.mark.parametrize(
    ("name", "values", "text"),
    [
        ("approach", np.ones((5, 3), "f4"), "table/approach: not of unit"),
        ("pose", np.full(5, -1), "table/pose: not a row of the object's tables"),
        ("pose", np.full(5, 2), "table/pose: not a row of the object's tables"),
    ],
)
def test_wrong_rows_are_refused(tmp_path, name, values, text):
    shard = sample_on_table()
    wrong = replace(shard, grasps=replace(shard.grasps, table=shard.grasps.table | {name: values}))
    with pytest.raises(ShardError, match=text):
        write_shard(tmp_path / "s.h5", wrong)
    assert not (tmp_path / "s.h5").exists()


@pytest.mark.parametrize(
    ("tables", "text"),
    [
        (None, "table/pose: not a row of the object's tables"),
        ([[0, 0, 1, 0, 1.5], [0, 1, 0, 0, 0]], "objects/cup/tables: a probability is not from 0 to 1"),
        ([[0, 0, 1, 0, 1], [0, 1, 0, 0, -0.1]], "objects/cup/tables: a probability is not from 0 to 1"),
        ([[0, 0, 1, 0, np.nan], [0, 1, 0, 0, 0]], "objects/cup/tables: .*a number not finite"),
    ],
)
def test_wrong_planes_are_refused(tmp_path, tables, text):
    shard = sample_on_table()
    cup = replace(shard.objects[0], tables=None if tables is None else np.array(tables, "f4"))
    with pytest.raises(ShardError, match=text):
        write_shard(tmp_path / "s.h5", replace(shard, objects=[cup]))


def test_half_a_group_is_no_shard(tmp_path):
    write_shard(tmp_path / "s.h5", sample_on_table())
    with h5py.File(tmp_path / "s.h5", "r+") as file:
        del file["grasps/table/pose"], file.attrs["text_sha256"]
    with pytest.raises(ShardError, match="grasps/table/pose: missing dataset"):
        read_shard(tmp_path / "s.h5")
