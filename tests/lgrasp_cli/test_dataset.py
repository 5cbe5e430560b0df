"""``lgrasp dataset``: shards are shown, checked and merged."""

import json

import pytest
from support.shards import sample_shard

from lgrasp.dataset.writer import write_shard


@pytest.fixture
def folder(tmp_path):
    for index in range(2):
        write_shard(tmp_path / f"{index}.h5", sample_shard(4, shard_index=index))
    return tmp_path


def test_info(cli, folder):
    text = cli("dataset", "info", folder)
    assert text.code == 0
    assert "2 shards" in text.out
    assert "penetration" in text.out
    machine = cli("dataset", "info", folder / "0.h5", "--json", "-")
    assert json.loads(machine.out)[0]["rows"] == 4


def test_check(cli, folder):
    assert cli("dataset", "check", folder).out == "2 shards valid\n"
    data = (folder / "1.h5").read_bytes()
    (folder / "1.h5").write_bytes(data[:-100])
    result = cli("dataset", "check", folder)
    assert (result.code, result.out) == (2, "")
    (line,) = result.err.splitlines()
    assert line.startswith(f"{folder / '1.h5'}: not a whole HDF5 file")
    machine = cli("dataset", "check", folder, "--json", "-")
    assert machine.code == 2
    assert [len(v) for v in json.loads(machine.out).values()] == [0, 1]


def test_merge(cli, folder):
    result = cli("dataset", "merge", folder, "--out", folder / "all.h5")
    assert (result.code, result.out) == (0, f"{folder / 'all.h5'}: 8 rows\n")
    assert str(folder / "none") in cli("dataset", "merge", folder / "none", "-o", folder / "x.h5").error()


def test_validate_is_the_old_name_of_check(cli, folder):
    old, new = (cli("dataset", name, folder) for name in ("validate", "check"))
    assert old.out == new.out
    words = "'lgrasp dataset validate' is now 'lgrasp dataset check'; the old name works in this release only"
    assert (old.err, new.err) == (f"warning: {words}\n", "")


@pytest.mark.parametrize(
    "words",
    [
        ("info", "--json"),
        ("report", "--out"),
        ("split", "--by", "pose", "--out"),
        ("normalisation", "--out"),
    ],
)
def test_files_of_another_kind_stay(cli, folder, words):
    (folder / "manifest.json").write_text('{"format": "lgrasp-manifest"}')
    (folder / "copy.json").write_text('{\n "format": "lgrasp-manifest"}')
    (folder / "mesh").write_text("v 0 0 0\n")
    for name in ("0.h5", "manifest.json", "copy.json", "mesh"):
        before = (folder / name).read_bytes()
        assert name in cli("dataset", words[0], folder, *words[1:], folder / name).error()
        assert (folder / name).read_bytes() == before
    again = folder / "again.json"
    for _ in range(2):
        assert cli("dataset", words[0], folder, *words[1:], again).code == 0
        assert again.stat().st_size
