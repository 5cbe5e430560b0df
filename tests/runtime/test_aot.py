"""Every kernel compiles for every GPU that lgrasp is meant for, without one: NVRTC ahead of time."""

import importlib
import os
from concurrent.futures import Future, ThreadPoolExecutor

import pytest
import warp as wp

from lgrasp.runtime.device import start
from lgrasp.runtime.kernels import import_all, kernel_modules

OLDEST, NEWEST = 75, 90  # what compiles for the oldest compiles for all after it; H100 and H200 are the newest

import_all()


@pytest.fixture(scope="module")
def compiled(request, tmp_path_factory):
    """(module, architecture) -> its PTX, for the tests that run; all cores compile, one module each."""
    start()
    own = [item for item in request.session.items if item.path == request.path and hasattr(item, "callspec")]
    chosen = {(item.callspec.params["name"], item.callspec.params["arch"]): Future() for item in own}
    folder = tmp_path_factory.mktemp("aot")

    def compile_all(name: str) -> None:
        for arch in [arch for module, arch in chosen if module == name]:
            out = folder / f"{name}-{arch}"
            try:
                wp.compile_aot_module(importlib.import_module(name), arch=arch, module_dir=out, use_ptx=True)
                chosen[name, arch].set_result("".join(file.read_text() for file in out.rglob("*.ptx")))
            except Exception as error:
                chosen[name, arch].set_exception(error)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for name in dict.fromkeys(module for module, _ in chosen):
            pool.submit(compile_all, name)
        yield chosen


def test_the_compiler_knows_the_architectures():
    start()
    known = wp._src.context.runtime.nvrtc_supported_archs
    assert {OLDEST, NEWEST} <= set(known), f"NVRTC of warp {wp.__version__} compiles for {sorted(known)}"


@pytest.mark.parametrize(
    ("name", "arch"), [(name, OLDEST) for name in kernel_modules()] + [("lgrasp.stages.search.swap_kernels", NEWEST)]
)
def test_kernels_compile(name, arch, compiled):
    assert f".target sm_{arch}" in compiled[name, arch].result()
