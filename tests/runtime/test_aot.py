"""Every kernel compiles for every GPU that lgrasp is meant for, without one: NVRTC ahead of time."""

import importlib

import pytest
import warp as wp

from lgrasp.runtime.device import start
from lgrasp.runtime.kernels import import_all, kernel_modules

OLDEST, NEWEST = 75, 90  # what compiles for the oldest compiles for all after it; H100 and H200 are the newest

DEBUG = {"lgrasp.hold.kernels"}  # large: with optimization it takes half a minute to compile

import_all()


def test_the_compiler_knows_the_architectures():
    start()
    known = wp._src.context.runtime.nvrtc_supported_archs
    assert {OLDEST, NEWEST} <= set(known), f"NVRTC of warp {wp.__version__} compiles for {sorted(known)}"


@pytest.mark.parametrize(
    ("name", "arch"), [(name, OLDEST) for name in kernel_modules()] + [("lgrasp.picture.depth_kernels", NEWEST)]
)
def test_kernels_compile(name, arch, tmp_path, monkeypatch):
    start()
    monkeypatch.setattr(wp.config, "mode", "debug" if name in DEBUG else "release")
    wp.compile_aot_module(importlib.import_module(name), arch=arch, module_dir=tmp_path, use_ptx=True)
    assert f".target sm_{arch}" in "".join(file.read_text() for file in tmp_path.rglob("*.ptx"))
