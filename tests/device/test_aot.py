"""Every kernel compiles for a GPU, without one: NVRTC ahead of time for the architecture of an H100 or H200."""

import importlib

import pytest
import warp as wp

from lgrasp.device.runtime import start
from lgrasp.engine.kernels import import_all, kernel_modules

import_all()


@pytest.mark.parametrize("name", kernel_modules())
def test_kernels_compile_for_sm_90(name, tmp_path):
    start()
    wp.compile_aot_module(importlib.import_module(name), arch=90, module_dir=tmp_path, use_ptx=True)
    code = list(tmp_path.rglob("*.ptx"))
    assert code, f"{name}: no code was written"
    assert all(".target sm_90" in file.read_text() for file in code)
