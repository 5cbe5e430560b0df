"""Rows of many shards as one list of scenes."""

import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest
from support.jaws import jaw_rows, jaw_shard

from lgrasp.dataset.scenes import SceneRows
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import ConfigError, ShardError


@pytest.fixture
def folder(tmp_path):
    """3 + 2 rows of two objects, in subfolders; the second shard's rows are opened further."""
    (tmp_path / "urdf").mkdir()
    first = jaw_shard(tmp_path / "urdf", jaw_rows(0.002, count=3))
    box = first.objects[0]
    other = replace(
        jaw_shard(tmp_path / "urdf", jaw_rows(0.002, opening=0.02, count=2)), objects=[replace(box, id="other")]
    )
    for name, shard in (("a", first), ("b", other)):
        (tmp_path / name).mkdir()
        write_shard(tmp_path / name / f"{name}.h5", shard)
    return tmp_path


def test_rows_are_counted_through_all_shards(folder):
    rows = SceneRows(folder)
    assert len(rows) == 5
    assert rows.place(2) == (folder / "a" / "a.h5", 2)
    assert rows.place(3) == (folder / "b" / "b.h5", 0)
    opening = [float(rows.scene(row).steps[0].stages["pregrasp"][0]) for row in range(5)]
    np.testing.assert_allclose(opening, [0.03] * 3 + [0.04] * 2, atol=1e-6)


def test_a_shard_that_cannot_be_used_is_left_out(folder, said):
    shutil.copy(folder / "a" / "a.h5", folder / "a" / "bad.h5")
    with h5py.File(folder / "a" / "bad.h5", "r+") as file:
        del file["grasps/contact_links"]
    assert SceneRows(folder).spread(9) == [0, 1, 2, 3, 4]
    assert len(said) == 1
    assert "1 of 3 files are left out" in said[0]


def test_spread_is_even_and_complete(folder):
    rows = SceneRows(folder)
    assert rows.spread(9) == [0, 1, 2, 3, 4]
    assert rows.spread(1) == [2]
    assert rows.spread(2) == [1, 3]


def test_shards_without_a_column_have_no_row_that_meets_it(folder, said):
    first, rows = folder / "a" / "a.h5", SceneRows(folder)
    with pytest.raises(ShardError, match="no column 'physics/fc_holds'"):
        rows.meeting("physics/fc_holds")
    with h5py.File(first, "r+") as file:
        n = len(file["grasps/q"])
        file.create_dataset("grasps/physics/fc_holds", data=np.arange(n) != 1).attrs["protocol"] = "{}"
        del file.attrs["text_sha256"]
    rows = SceneRows(folder)
    assert list(rows.meeting("physics/fc_holds")) == [k for k in range(n) if k != 1]
    assert "1 of 2 shards are left out, first " in said[-1]
    assert "b.h5: no column 'physics/fc_holds'" in said[-1]
    assert len(rows.meeting("metrics/valid == 1")) == 5


def test_captions_tell_what_differs(folder):
    rows = SceneRows(folder)
    assert rows.caption(1, [0, 1]) == "row 1"
    assert rows.caption(4, [0, 4]) == "other · row 4"


def test_files_that_change_while_they_are_looked_at(folder):
    rows = SceneRows(folder)
    assert rows.read(2)[0].name == rows.read(0)[0].name
    write_shard(folder / "a" / "a.h5", jaw_shard(folder / "urdf", jaw_rows(0.002, count=1)))
    with pytest.raises(ShardError, match=r"a\.h5 was replaced: it has 1 row in place of 3; open it again"):
        rows.scene(2)
    assert rows.read(4)
    name = rows.columns()[0]
    for ask in (lambda: rows.column(name), lambda: rows.meeting(f"{name} >= 0"), lambda: rows.numbers(0)):
        with pytest.raises(ShardError, match=r"a\.h5 was replaced"):
            ask()
    (folder / "a" / "a.h5").unlink()
    assert rows.caption(4, [0, 4]) == "row 4"
    with pytest.raises(ShardError, match=r"a\.h5"):
        rows.read(0)


def test_captions_name_what_a_row_holds(tmp_path, make_sequence):
    shard = make_sequence((1, 1))
    write_shard(tmp_path / "a.h5", shard)
    first, second = (shard.objects[k].id for k in shard.grasps.object_index[1, :2])
    rows = SceneRows(tmp_path)
    assert rows.caption(0, [0, 1]) == f"{first} · row 0"
    assert rows.caption(1, [0, 1]) == f"{first} + {second} · row 1"


def test_rows_that_are_not_there(folder, tmp_path):
    with pytest.raises(ConfigError, match="row 5 does not exist; there are 0 to 4"):
        SceneRows(folder).scene(5)
    empty = jaw_shard(folder / "urdf", jaw_rows(0.002, count=0))
    write_shard(folder / "empty.h5", empty)
    with pytest.raises(ShardError, match="no row to look at"):
        SceneRows(folder / "empty.h5")
