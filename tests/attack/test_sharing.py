"""Several computers and several users on one folder."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from lgrasp import files
from lgrasp.dataset.manifest import ListedRun, ListedShard, read_manifest, update_manifest
from lgrasp.engine.cache import Cache
from lgrasp.files import new_file, remove_leftovers


def leftover(folder: Path, monkeypatch: pytest.MonkeyPatch, machine: str) -> Path:
    """A temporary file as a killed process on a computer leaves it."""
    with monkeypatch.context() as patch:
        patch.setattr(files, "_machine", lambda: machine)
        with new_file(folder / "a.h5") as file:
            (name,) = folder.glob(f"a.{machine}-*.tmp")
            file.write(b"half")
            file.flush()
            shutil.copy(name, folder / f"{name.name}x")
    (folder / "a.h5").unlink()
    return (folder / f"{name.name}x").rename(name)


def test_files_of_other_computers_stay_for_a_day(tmp_path, monkeypatch):
    """Locks of network file systems may be known to one computer only."""
    here = files._machine()
    own = leftover(tmp_path, monkeypatch, here)
    before_start = leftover(tmp_path, monkeypatch, here[:6] + "0" * 6)
    other, old = leftover(tmp_path, monkeypatch, "f" * 12), leftover(tmp_path, monkeypatch, "e" * 12)
    os.utime(old, times=(0.0, 0.0))
    remove_leftovers(tmp_path, "*.tmp")
    assert [path.exists() for path in (own, before_start, other, old)] == [False, False, True, False]


def test_a_file_being_written_stays(tmp_path):
    with new_file(tmp_path / "a.h5") as file:
        file.write(b"half")
        remove_leftovers(tmp_path, "*.tmp")
        assert len(list(tmp_path.glob("*.tmp"))) == 1
    assert (tmp_path / "a.h5").read_bytes() == b"half"


@pytest.fixture
def common() -> Iterator[Path]:
    """A folder of a group."""
    folder = Path(tempfile.mkdtemp(prefix="lgrasp-common-"))
    os.chmod(folder, 0o2775)
    os.chown(folder, -1, 4000)
    yield folder
    shutil.rmtree(folder)


def by_user(number: int, action: Callable[[], bool]) -> None:
    """Do something in another process as a user of the group; it must say True."""
    child = os.fork()
    if child == 0:
        done = False
        try:
            os.setgroups([])
            os.setgid(4000)
            os.setuid(number)
            os.umask(0o002)
            done = action()
        finally:
            os._exit(0 if done else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to be two users")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_two_users_share_a_cache(common, tmp_path):
    """An entry of one is read, and replaced, by the other without a word."""
    said: list[str] = []

    def store(value: float) -> bool:
        Cache(common, said.append).store("bank", "key", {"a": np.full(3, value)})
        return not said

    def found(value: float) -> bool:
        arrays = Cache(common, said.append).load("bank", "key")
        return not said and arrays is not None and arrays["a"].tolist() == [value] * 3

    Cache(tmp_path).store("bank", "key", {"a": np.zeros(3)})  # imports what the others may not read
    assert Cache(tmp_path).load("bank", "key") is not None
    by_user(4001, lambda: store(1.0))
    by_user(4002, lambda: found(1.0) and store(2.0))
    by_user(4001, lambda: found(2.0))


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to be two users")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_two_users_share_a_manifest(common):
    """What one lists stays when the other, who may not write the file but the folder, lists more."""

    def listing(name: str) -> bool:
        run = ListedRun(run_key=name, shards=[ListedShard(file=f"{name}.h5", shard_index=0, rows=0)])
        update_manifest(common, lambda manifest: manifest.ask(run, (), {}))
        os.chmod(common / "manifest.json", 0o644)
        return True

    for user, name in ((4001, "a"), (4002, "b"), (4001, "c")):
        by_user(user, lambda name=name: listing(name))
    found = read_manifest(common / "manifest.json")
    assert found is not None
    assert [shard.file for shard in found.shards] == ["a.h5", "b.h5", "c.h5"]
