"""Damaged, unwritable and left-over kernels: every command does what it did, and says what it met."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from lgrasp.engine.cache import Cache

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
load_kernels("cpu", sys.argv[2:])
x = wp.array(np.arange(4.0), dtype=wp.float32, device="cpu")
for module in modules:
    wp.launch(module.double, 4, [x], device="cpu")
print(int(x.numpy()[1]))
"""

KERNEL = """
import warp as wp

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
    "truncated": (".o", lambda path: os.truncate(path, 200)),
    "empty": (".o", lambda path: os.truncate(path, 0)),
    "flipped": (".o", flip),
    "gone": (".o", Path.unlink),
    "meta": (".meta", lambda path: path.write_text("{")),
}


@pytest.fixture
def double(tmp_path: Path):
    """double(cache): double a number by the kernel of each module, in another process; gives its standard error."""
    (tmp_path / "code").mkdir()
    for name in DAMAGE:
        (tmp_path / "code" / f"{name}.py").write_text(KERNEL)

    def run(cache: Path) -> str:
        env = {name: value for name, value in os.environ.items() if name != "WARP_CACHE_PATH"}
        command = [sys.executable, "-c", CODE, str(tmp_path / "code"), *DAMAGE]
        env["LGRASP_CACHE_DIR"] = str(cache)
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr
        assert int(done.stdout) == 2 ** len(DAMAGE)
        return done.stderr

    return run


def test_damaged_kernels_are_compiled_again(double, tmp_path):
    cache = tmp_path / "cache"
    assert double(cache) == ""
    for name, (suffix, damage) in DAMAGE.items():
        (path,) = cache.rglob(f"wp_{name}_*/*{suffix}")
        damage(path)
    said = double(cache).splitlines()
    assert len(said) == len(DAMAGE)
    assert all(line.endswith("is damaged; compiling it again") for line in said)
    assert double(cache) == ""
    assert not list(cache.rglob("*.tmp"))


def test_a_folder_that_cannot_be_made(double, tmp_path):
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "kernels").write_text("a file where the folder should be")
    said = double(tmp_path / "cache")
    assert said.count("kernels cannot be kept in") == 1
    assert "--cache-dir" in said


def test_left_overs_are_pruned(tmp_path):
    cache = tmp_path / "cache"
    whole = cache / "kernels" / "1.0" / "wp_some_module_1234567"
    whole.mkdir(parents=True)
    gone = whole.with_name(whole.name + "_p999999999_t1")
    alive = whole.with_name(f"{whole.name}_p{os.getpid()}_t1")
    shutil.copytree(whole, gone)
    shutil.copytree(whole, alive)
    Cache(cache).prune({"bank"})
    assert whole.exists()
    assert alive.exists()
    assert not gone.exists()
