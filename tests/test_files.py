"""Whole files and folders, and what processes that were killed leave of them."""

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from lgrasp.errors import OutputError
from lgrasp.files import discard_temporaries, new_file, new_folder, remove_leftovers, scratch_folder, write_file

KILLED = """
import os, signal, sys, tempfile
from pathlib import Path
from lgrasp.files import new_file, new_folder, temporary_folder
path = Path(sys.argv[2])
tempfile.tempdir = str(path.parent)
with {"file": new_file, "folder": new_folder, "scratch": lambda path: temporary_folder()}[sys.argv[1]](path) as made:
    if sys.argv[1] != "file":
        (made / "half").touch()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def kill(what: str, path: Path) -> Path:
    """What is left of a path by a process that was killed while it made it."""
    done = subprocess.run([sys.executable, "-c", KILLED, what, str(path)], timeout=60, check=False)
    assert done.returncode == -signal.SIGKILL
    (left,) = (p for p in path.parent.glob("*.tmp") if p.name.startswith(f"{path.stem}."))
    return left


@pytest.mark.parametrize("name", ["a.h5", "a[1].h5", "a b"])
def test_a_file_takes_what_was_left_of_it_away(tmp_path, name):
    left, other = kill("file", tmp_path / name), kill("file", tmp_path / "other.h5")
    write_file(tmp_path / name, "whole")
    assert (tmp_path / name).read_text() == "whole"
    assert not left.exists()
    assert other.exists()


def test_a_folder_is_whole_or_absent(tmp_path):
    left = kill("folder", tmp_path / "made")
    with new_folder(tmp_path / "made") as made:
        (made / "one").touch()
        assert not (tmp_path / "made").exists()
    assert not left.exists()
    assert [path.name for path in tmp_path.rglob("*")] == ["made", "one"]
    with pytest.raises(FileNotFoundError), new_folder(tmp_path / "made") as made:
        (made / "two" / "three").touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["made", "one"]
    with new_folder(tmp_path / "made") as made:
        (made / "three").touch()
        with new_folder(tmp_path / "made"):  # another writer does not take what is being made
            pass
    assert [path.name for path in tmp_path.rglob("*")] == ["made", "three"]
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="File exists"), new_folder(tmp_path / "file" / "made"):
        pass


def test_temporary_folders_of_killed_processes_go(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    left = kill("scratch", tmp_path / "lgrasp")
    first = scratch_folder()
    assert not left.exists()
    assert scratch_folder() != first
    assert first.stat().st_mode & 0o777 == 0o700
    assert len(list(tmp_path.iterdir())) == 2
    discard_temporaries()
    assert not list(tmp_path.iterdir())


def test_a_process_that_is_ended_removes_what_it_was_writing(tmp_path):
    with pytest.raises(OutputError, match="No such file"), new_file(tmp_path / "made") as file:
        _ = discard_temporaries(), file.write(b"by a thread that goes on")
    assert not list(tmp_path.iterdir())


def test_a_pipe_does_not_hold_up(tmp_path):
    os.mkfifo(tmp_path / "lgrasp.tmp")
    assert remove_leftovers(tmp_path, "*.tmp") == [tmp_path / "lgrasp.tmp"]
