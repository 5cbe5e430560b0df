"""Every kernel compiles for every GPU that lgrasp is meant for, without one: NVRTC ahead of time."""

import importlib
from pathlib import Path

import pytest
import warp as wp
from warp._src import codegen

from lgrasp.files import write_file
from lgrasp.runtime.device import start
from lgrasp.runtime.kernels import import_all, kernel_modules

OLDEST, NEWEST = 75, 90  # what compiles for the oldest compiles for all after it; H100 and H200 are the newest

import_all()


def test_the_compiler_knows_the_architectures():
    start()
    known = wp._src.context.runtime.nvrtc_supported_archs
    assert {OLDEST, NEWEST} <= set(known), f"NVRTC of warp {wp.__version__} compiles for {sorted(known)}"


@pytest.mark.parametrize(
    ("name", "arch"), [(name, OLDEST) for name in kernel_modules()] + [("lgrasp.picture.depth", NEWEST)]
)
def test_kernels_compile(name, arch, tmp_path, monkeypatch):
    """What compiled is noted beside the compiled kernels, by the hash that Warp tells changed ones by."""
    start()
    monkeypatch.setitem(codegen._INLINE_ATTRS, None, "WP_NOINLINE ")  # of no matter to what compiles, but for the time
    cache = Path(wp.config.kernel_cache_dir)
    note = cache.parent / "ahead_of_time" / cache.name / f"{wp.get_module(name).get_module_identifier()}.sm_{arch}"
    if not note.is_file():
        wp.compile_aot_module(importlib.import_module(name), arch=arch, module_dir=tmp_path, use_ptx=True)
        note.parent.mkdir(parents=True, exist_ok=True)
        lines = [line for file in tmp_path.rglob("*.ptx") for line in file.read_text().splitlines()]
        write_file(note, "\n".join(line for line in lines if line.startswith(".target")))
    assert f".target sm_{arch}" in note.read_text()
