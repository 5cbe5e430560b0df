"""README, quickstart and the page on steering run as written, but with fewer rows, a small contact field, coarse convex
pieces and plain pictures, in an empty folder; the first two with what a wheel installs."""

import json
import os
import re
import shlex
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.kernels import kernel_folder
from support.pictures import PLAIN
from support.places import QUICK, ROOT

from lgrasp.geometry import decompose

BLOCK = re.compile(r"^(<!-- not run.*?-->\n)?```(bash|python)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FEWER = {
    "build-field": ("-p", QUICK),
    "generate": ("-n", "2", "--set", "field.records=20000"),  # the field of QUICK
    "render": ("-n", "2"),
}
SETTINGS = PLAIN | {"lgrasp.geometry.decompose._TREE_SEARCH": decompose._TREE_SEARCH | {"threshold": 0.05}}

SCRIPT = """
import json, os, sys
from importlib import import_module
import lgrasp
from lgrasp_cli.main import main
print(lgrasp.__file__)
pages, settings = json.load(sys.stdin)
for name, value in settings.items():
    module, _, attribute = name.rpartition(".")
    assert hasattr(import_module(module), attribute)
    setattr(import_module(module), attribute, value)
for page, commands in pages.items():
    os.makedirs(page)
    os.chdir(page)
    for words in commands:
        sys.argv = ["lgrasp", *words]
        try:
            main()
        except SystemExit as leaving:
            if leaving.code:
                sys.exit(f"{leaving.code}: {page}: {sys.argv}")
    os.chdir("..")
"""


def blocks(page: str) -> Iterator[tuple[str, str]]:
    """Language and text of what a page says to run."""
    text = (ROOT / page).read_text(encoding="utf-8")
    assert not re.search(r"^```\n(lgrasp|pip|make|python) ", text, re.MULTILINE), "a block of commands says ```bash"
    return ((language, block) for marker, language, block in BLOCK.findall(text) if not marker)


def commands(block: str) -> Iterator[list[str]]:
    """The words of each line after lgrasp, with fewer rows."""
    for line in block.splitlines():
        command, *words = shlex.split(line)  # no comments: zsh takes them as words
        assert command == "lgrasp"
        yield [*words, *FEWER.get(words[0], ())]


def test_steering_runs_as_written(cli, tmp_path):
    pytest.importorskip("mujoco")
    ran = 0
    for language, block in blocks("docs/guides/steer.md"):
        if language == "python":
            exec(block, {})
            continue
        for words in commands(block):
            result = cli(*words)
            assert result.code == 0, (words, result)
            assert "warning" not in result.err, (words, result)
            ran += 1
    assert ran >= 5
    assert list(tmp_path.glob("grasps/allegro-mug/robust*/*.h5"))


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder with what the wheel holds."""
    builder = pytest.importorskip("hatchling.builders.wheel").WheelBuilder(str(ROOT))
    folder = tmp_path_factory.mktemp("wheel")
    (wheel,) = builder.build(directory=str(folder), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "installed")
    return folder / "installed"


def test_pages_run_with_a_wheel(installed, shared_cache, tmp_path):
    """Nothing but what the wheel holds is there of the project; each page begins in an empty folder."""
    pytest.importorskip("mujoco")
    ran = {}
    for page in ("README.md", "docs/guides/quickstart.md"):
        ran[Path(page).stem] = [
            words for language, block in blocks(page) if language == "bash" for words in commands(block)
        ]
        assert len(ran[Path(page).stem]) >= 5
    env = {name: value for name, value in os.environ.items() if not name.startswith(("SLURM_", "LGRASP_"))}
    env |= {"PYTHONPATH": str(installed), "LGRASP_CACHE_DIR": str(shared_cache)}
    env["WARP_CACHE_PATH"] = str(kernel_folder())
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        input=json.dumps([ran, SETTINGS]),
        env=env,
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(installed))
    assert "warning" not in done.stderr
    for page in ran:
        assert list((tmp_path / page).glob("grasps/allegro-mug/robust*/*.h5"))
