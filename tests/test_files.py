"""Whole files and folders, and what processes that were killed leave of them."""

import ast
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from support.places import ROOT
from support.sources import modules_with, parse

from lgrasp.errors import OutputError
from lgrasp.files import (
    discard_temporaries,
    new_file,
    new_folder,
    remove_leftovers,
    scratch_folder,
    temporary_folder,
    write_file,
)

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
    (left,) = (p for p in path.parent.glob("*.tmp") if path.stem.startswith(p.name.partition(".")[0]))
    return left


@pytest.mark.parametrize("name", ["a.h5", "a[1].h5", "a b", f"{'ü' * 126}.h5"])
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


def test_a_folder_that_is_taken_for_a_leftover_at_once_is_made_again(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    mkdir, taken = Path.mkdir, []

    def take(path, *more, **options):
        mkdir(path, *more, **options)
        if path.suffix == ".tmp" and len(taken) < 3:
            taken.extend(remove_leftovers(path.parent, path.name))

    monkeypatch.setattr(Path, "mkdir", take)
    with temporary_folder() as folder, new_folder(tmp_path / "made"):
        (folder / "one").touch()
    assert len(taken) == 3
    assert [path.name for path in tmp_path.rglob("*")] == ["made"]


def test_a_process_that_is_ended_removes_what_it_was_writing(tmp_path):
    with pytest.raises(OutputError, match="No such file"), new_file(tmp_path / "made") as file:
        _ = discard_temporaries(), file.write(b"by a thread that goes on")
    assert not list(tmp_path.iterdir())


def test_a_link_stays(tmp_path):
    (tmp_path / "store").mkdir()
    file, link = tmp_path / "store" / "a.h5", tmp_path / "b.h5"
    file.write_text("old")
    link.symlink_to(file)
    write_file(link, "new")
    assert link.is_symlink()
    assert file.read_text() == "new"
    assert not list(tmp_path.rglob("*.tmp"))


def test_a_pipe_does_not_hold_up(tmp_path):
    os.mkfifo(tmp_path / "lgrasp.tmp")
    assert remove_leftovers(tmp_path, "*.tmp") == [tmp_path / "lgrasp.tmp"]


WRITERS = {"write_text", "write_bytes", "copyfile", "copytree", "save", "savez", "savefig", "dump", "imwrite", "imsave"}
WRITTEN_BY_HAND = {
    "lgrasp/api.py": "grasps that are saved as a shard",
    "lgrasp/bench/soak/processes.py": "a temporary folder",
    "lgrasp/bench/soak/trials.py": "a temporary folder",
    "lgrasp/dataset/report/plots.py": "a picture in memory",
    "lgrasp/dataset/writer.py": "a file of lgrasp.files",
    "lgrasp/engine/cache.py": "arrays in memory",
    "lgrasp/files.py": "the home",
    "lgrasp/geometry/decompose.py": "a pipe",
    "lgrasp/grasp/hand_files.py": "a temporary folder, or that of an export",
    "lgrasp/hand/drafting/import_urdf.py": "a folder that is whole or absent",
    "lgrasp/hand/drafting/mjcf.py": "a temporary folder",
    "lgrasp/hand/drafting/vary.py": "a folder that is whole or absent",
    "lgrasp/hand/drafting/write.py": "a folder that is whole or absent",
    "lgrasp/judge/files.py": "a file that is whole or absent; the judge stands alone",
    "lgrasp/judge/run.py": "a temporary folder",
    "lgrasp/learn/loop.py": "the state of a training in memory",
    "lgrasp/learn/networks.py": "a network in memory",
    "lgrasp/object/load.py": "reads a scene",
    "lgrasp/picture/sheet.py": "a picture in memory",
    "lgrasp/policy/model.py": "a network in memory",
    "lgrasp/runtime/kernel_cache.py": "a temporary folder",
    "lgrasp_cli/__main__.py": "standard streams",
}


def test_files_are_written_in_one_place():
    """Every file of a user is made by lgrasp.files; a new module that writes says here where to."""
    found = set()
    for path in modules_with("open", "File", *WRITERS):
        for call in ast.walk(parse(path)):
            if isinstance(call, ast.Call) and _writes(call):
                found.add(path.relative_to(ROOT).as_posix())
    assert found == set(WRITTEN_BY_HAND)


def _writes(call: ast.Call) -> bool:
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    if name not in ("open", "File", "fdopen"):
        return name in WRITERS
    modes = {a.value for a in (*call.args, *(k.value for k in call.keywords)) if isinstance(a, ast.Constant)}
    return bool(modes & {"w", "wb", "x", "xb", "a", "ab", "r+", "r+b", "w+b", "wt"})
