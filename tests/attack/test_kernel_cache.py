"""Damaged, unwritable and left-over kernels: every command does what it did, and says what it met."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from lgrasp.engine.cache import Cache
from lgrasp.files import discard_temporaries
from lgrasp.runtime import kernel_cache
from lgrasp.runtime.kernel_cache import drop_damaged, enter, note_checksums, remove_unfinished, usable_folder
from lgrasp.runtime.kernels import load_kernels

CODE = """
import importlib
import sys
import numpy as np
import warp as wp
from lgrasp.notices import on_notice
from lgrasp.runtime.device import start
on_notice(lambda line: print(line, file=sys.stderr))
start()
sys.path.insert(0, sys.argv[1])
from lgrasp.runtime.kernels import load_kernels
modules = [importlib.import_module(name) for name in sys.argv[2:]]
for name in sys.argv[2:]:
    load_kernels("cpu", [name])  # each thread would compile headers of its own
x = wp.array(np.arange(4.0), dtype=wp.float32, device="cpu")
for module in modules:
    wp.launch(module.double, 4, [x], device="cpu")
print(int(x.numpy()[1]))
"""

KERNEL = """
import warp as wp

wp.set_module_options({"enable_backward": False, "optimization_level": 0})

@wp.kernel
def double(x: wp.array(dtype=wp.float32)):
    x[wp.tid()] = 2.0 * x[wp.tid()]
"""


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    for at in range(len(data) // 2, len(data) // 2 + 40):
        data[at] ^= 0xFF
    path.write_bytes(data)


DAMAGE = {
    "truncated": ("code.o", lambda path: os.truncate(path, 200)),
    "empty": ("code.o", lambda path: os.truncate(path, 0)),
    "flipped": ("code.o", flip),
    "gone": ("code.o", Path.unlink),
    "meta": ("code.meta", lambda path: path.write_text("{")),
}


@pytest.fixture
def double(tmp_path: Path):
    """double(cache, *modules): double a number by the kernel of each, in another process; gives its standard error."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "flipped.py").write_text(KERNEL)

    def run(cache: Path, *modules: str) -> str:
        env = {name: value for name, value in os.environ.items() if name != "WARP_CACHE_PATH"}
        command = [sys.executable, "-c", CODE, str(tmp_path / "code"), *modules]
        env["LGRASP_CACHE_DIR"] = str(cache)
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr
        assert int(done.stdout) == 2 ** len(modules)
        return done.stderr

    return run


def test_damaged_kernels_are_compiled_again(double, said, tmp_path):
    cache = tmp_path / "cache"
    assert double(cache, "flipped") == ""
    (path,) = cache.rglob("wp_flipped_*/*.o")
    flip(path)
    (line,) = double(cache, "flipped").splitlines()
    assert line.endswith("is damaged; compiling it again")
    (folder,) = cache.glob("kernels/*")
    drop_damaged(folder)
    assert said == []
    assert len(list(folder.glob("wp_*"))) == 1
    assert not list(cache.rglob("*.tmp"))
    flip(path)  # what was compiled again is noted as well
    drop_damaged(folder)
    assert len(said) == 1
    assert not path.exists()


def test_every_damage_is_seen(said, tmp_path):
    for name in ("whole", *DAMAGE):
        (tmp_path / name).mkdir()
        (tmp_path / name / "code.o").write_bytes(bytes(range(256)) * 4)
        (tmp_path / name / "code.meta").write_text("{}")
    note_checksums(tmp_path)
    for name, (file, damage) in DAMAGE.items():
        damage(tmp_path / name / file)
    drop_damaged(tmp_path)
    assert sorted(line.split()[1] for line in said) == sorted(DAMAGE)
    assert [path.name for path in tmp_path.iterdir()] == ["whole"]


def test_kernels_that_nobody_noted(said, tmp_path):
    def compiled() -> Path:
        (tmp_path / "wp_a").mkdir(exist_ok=True)
        (tmp_path / "wp_a" / "code.o").touch()  # cut off as the machine went down
        return tmp_path / "wp_a"

    module, other = compiled(), tmp_path / "p1.x.tmp"
    other.touch()
    drop_damaged(tmp_path)
    assert module.exists(), "another process may be about to note them"
    other.unlink()
    drop_damaged(tmp_path)
    assert not module.exists()
    (compiled() / "sha256.json").touch()
    drop_damaged(tmp_path)
    assert not module.exists()
    assert said == []


def test_a_disk_that_becomes_full(said, tmp_path, monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(kernel_cache, "LEAST_FREE", 1 << 62)
    load_kernels("cpu", [])
    assert wp.config.kernel_cache_dir != str(tmp_path)
    (line,) = said
    assert "disk full" in line


def test_a_folder_that_cannot_be_made(said, tmp_path):
    (tmp_path / "kernels").write_text("a file where the folder should be")
    assert usable_folder(tmp_path / "kernels").is_dir()
    (line,) = said
    assert "kernels cannot be kept in" in line
    assert "--cache-dir" in line


KILLED = """
import os, signal, sys
from pathlib import Path
from lgrasp.runtime.kernel_cache import enter
folder = Path(sys.argv[1])
enter(folder)
(folder / f"wp_module_1234567_p{os.getpid()}_t1").mkdir()
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_compiler_left_goes_when_the_next_process_starts(tmp_path):
    """Numbers of processes say nothing: the folder may be shared with other computers."""
    whole = tmp_path / "wp_module_1234567"
    foreign = tmp_path / "wp_module_1234567_p999999999_t1"
    old = tmp_path / "wp_module_1234567_p999999998_t1"
    alive = tmp_path / f"wp_module_1234567_p{os.getpid()}_t1"
    dropped = tmp_path / "0123456789ab.tmp"
    for folder in (whole, foreign, old, alive, dropped):
        folder.mkdir()
    os.utime(old, times=(0.0, 0.0))
    enter(tmp_path)
    try:
        done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], timeout=60, check=False)
        assert done.returncode == -signal.SIGKILL
        assert len(list(tmp_path.glob("p*.tmp"))) == 2
        remove_unfinished(tmp_path)
        (note,) = tmp_path.glob("p*.tmp")
        assert note.name.startswith(f"p{os.getpid()}.")
        assert set(tmp_path.iterdir()) == {whole, foreign, alive, note}
    finally:
        discard_temporaries()  # this process was compiling when it was ended
    assert set(tmp_path.iterdir()) == {whole, foreign}


def test_pruning_the_cache_removes_them_too(tmp_path):
    left = tmp_path / "kernels" / "1.0" / "0123456789ab.tmp"
    left.mkdir(parents=True)
    Cache(tmp_path).prune({"bank"})
    assert not left.exists()
