"""Starting Warp: quiet, without swallowing what others write."""

import importlib
import shutil
import subprocess
import sys
from pathlib import Path
from threading import Thread

import pytest
import warp as wp

from lgrasp.errors import DeviceError
from lgrasp.runtime.device import resolve_device
from lgrasp.runtime.kernels import first_time, load_launched


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_start_is_silent():
    result = run("from lgrasp.runtime.device import resolve_device; print(resolve_device('cpu').alias)")
    assert result.stdout.strip() == "cpu"
    assert result.stderr == ""


def test_other_native_output_during_the_start_is_kept():
    code = """
import os, warp as wp
from lgrasp.runtime import device as runtime
init = wp.init
def noisy():
    os.write(2, b"disk is full\\n")
    init()
wp.init = noisy
runtime.start()
os.write(2, b"after\\n")
"""
    assert run(code).stderr.splitlines() == ["disk is full", "after"]


def test_error_during_the_start_is_kept():
    code = """
import os, warp as wp
from lgrasp.runtime import device as runtime
def broken():
    os.write(2, b"no native library\\n")
    raise RuntimeError("broken install")
wp.init = broken
runtime.start()
"""
    result = run(code)
    assert result.returncode != 0
    assert "no native library" in result.stderr
    assert "broken install" in result.stderr


def test_closed_stderr_does_not_stop_the_start():
    code = (
        "import os; os.close(2); from lgrasp.runtime.device import resolve_device; print(resolve_device('cpu').alias)"
    )
    assert run(code).stdout.strip() == "cpu"


def test_a_forked_process_is_told_that_it_cannot_use_a_gpu():
    code = """
import os, warp as wp
from lgrasp.runtime.device import resolve_device, start
start()
wp.get_cuda_device_count = lambda: 1
if os.fork():
    os._exit(os.waitstatus_to_exitcode(os.wait()[1]))
print(resolve_device("cpu").alias, flush=True)
resolve_device("auto")
"""
    result = run(code)
    assert (result.returncode, result.stdout) == (1, "cpu\n")
    assert result.stderr.endswith("forked process cannot use cuda:0: choose cpu, or start the process by 'spawn'\n")


@pytest.mark.parametrize("name", ["gpu", "cuda:99", "", "cpu:0"])
def test_unknown_device_lists_what_exists(name):
    with pytest.raises(DeviceError, match=r"choose auto, cpu"):
        resolve_device(name)


def test_the_first_kernels_of_a_job_are_announced(tmp_path, monkeypatch):
    """Also where others were compiled, or the same ones with other code or for another kind of device."""
    modules = ["lgrasp.object.kernels", "lgrasp.hand.distance", "lgrasp.hand.pairs"]
    for name in modules:
        importlib.import_module(name)
        wp.load_module(name, "cpu")
    assert first_time("cpu", modules) == ""
    compiled = Path(wp.config.kernel_cache_dir)
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    (tmp_path / "wp_lgrasp.object.kernels_1234567").mkdir()
    (tmp_path / "wp_lgrasp.object.kernels_1234567" / "module.cpu.o").touch()
    said = []
    for name in modules:
        said.append(first_time("cpu", modules))
        folder = wp.get_module(name).get_module_identifier(1)
        shutil.copytree(compiled / folder, tmp_path / folder)
    words = "compiling kernels once for this machine (up to 60 s on two cores)"
    assert said == [words, words, ""]
    assert first_time("cuda:0", modules) != ""


@wp.kernel(module="unique")
def _add_one(x: wp.array(dtype=wp.int32)):
    x[wp.tid()] += 1


@wp.kernel(module="unique")
def _add_two(x: wp.array(dtype=wp.int32)):
    x[wp.tid()] += 2


def test_what_a_library_launches_is_loaded_before_it_runs(monkeypatch):
    x, y = (wp.zeros(3, dtype=wp.int32, device="cpu") for _ in range(2))
    loaded, before = [], (wp.launch, wp.capture_while)
    wp.load_module(_add_one.module, "cpu")

    def library():
        wp.launch(_add_one, 3, outputs=[x], device="cpu")
        wp.capture_while(x, lambda k: wp.launch(_add_two, k, outputs=[x], device="cpu", block_dim=1), k=3)
        other = Thread(target=lambda: wp.launch(_add_one, 3, outputs=[y], device="cpu"))
        other.start()
        other.join()

    with monkeypatch.context() as patch:
        real = wp.load_module
        patch.setattr(wp, "load_module", lambda module, *a, **k: loaded.append(module) or real(module, *a, **k))
        load_launched(library, "cpu")
    assert set(loaded) == {_add_one.module, _add_two.module}
    assert not x.numpy().any()
    assert (y.numpy() == 1).all()  # what others do meanwhile is done
    assert (wp.launch, wp.capture_while) == before
    with pytest.raises(ZeroDivisionError):
        load_launched(lambda: 1 / 0, "cpu")
    assert (wp.launch, wp.capture_while) == before


def test_auto_is_one_of_the_devices():
    device = resolve_device()
    assert device.is_cuda == (device.alias != "cpu")
    assert device.name
