import json

import pytest
from typer.testing import CliRunner

from lgrasp import notices
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import ShardError
from lgrasp_cli.dataset import app


@pytest.fixture
def run():
    def call(*arguments):
        return CliRunner().invoke(app, [str(a) for a in arguments])

    return call


@pytest.fixture
def folder(tmp_path, make_shard):
    for index in range(2):
        write_shard(tmp_path / f"{index}.h5", make_shard(4, shard_index=index))
    return tmp_path


def test_info(run, folder):
    text = run("info", folder)
    assert text.exit_code == 0
    assert "2 shards" in text.stdout
    assert "penetration" in text.stdout
    machine = run("info", folder / "0.h5", "--json", "-")
    assert json.loads(machine.stdout)[0]["rows"] == 4


def test_validate(run, folder):
    assert run("check", folder).stdout == "2 shards valid\n"
    data = (folder / "1.h5").read_bytes()
    (folder / "1.h5").write_bytes(data[:-100])
    result = run("check", folder)
    assert result.exit_code == 2
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"{folder / '1.h5'}: not a whole HDF5 file")
    machine = run("check", folder, "--json", "-")
    assert machine.exit_code == 2
    assert [len(v) for v in json.loads(machine.stdout).values()] == [0, 1]


def test_merge(run, folder):
    result = run("merge", folder, "--out", folder / "all.h5")
    assert (result.exit_code, result.stdout) == (0, f"{folder / 'all.h5'}: 8 rows\n")
    result = run("merge", folder / "none", "-o", folder / "x.h5")
    assert isinstance(result.exception, ShardError)


@pytest.mark.parametrize("command", ["info", "check", "merge"])
def test_help_has_an_example(run, command):
    assert f"Example: lgrasp dataset {command}" in run(command, "--help").stdout


def test_validate_is_the_old_name_of_check(run, folder, monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(notices, "_said", set())
    monkeypatch.setattr(notices, "_listeners", [said.append])
    assert run("validate", folder).stdout == run("check", folder).stdout
    assert said == ["'lgrasp dataset validate' is now 'lgrasp dataset check'; the old name works in this release only"]
