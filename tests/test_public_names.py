"""``import lgrasp as lg``: what it gives is what the pages say, light, and the pages that use it run."""

import ast
import contextlib
import importlib
import io
import json
import re
import sys
from pathlib import Path

import pytest
from support.fresh import HEAVY, loaded
from support.places import ROOT

import lgrasp as lg

PAGES = [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.M | re.S)


def test_names_are_those_of_the_page():
    page = (ROOT / "docs" / "reference" / "api.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^- `lg\.(\w+)", page, re.M)) == sorted(lg.__all__)


def test_every_name_is_there():
    assert all(getattr(lg, name) is not None for name in lg.__all__)
    assert set(lg.__all__) <= set(dir(lg))
    assert not hasattr(lg, "no_such_name")


def test_importing_loads_nothing():
    assert loaded("import lgrasp", ["lgrasp.", *HEAVY]) == []


def test_functions_keep_their_names_beside_rooms():
    """Rooms called simulate, refine, sequence and judge may be imported before and after."""
    for name in ("simulate", "refine", "sequence", "judge"):
        room = importlib.import_module(f"lgrasp.{name}")
        assert callable(getattr(lg, name))
        assert sys.modules[f"lgrasp.{name}"] is room
    from lgrasp.simulate.protocol import find_protocol

    assert find_protocol("fc").name == "fc"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_pages_import_from_the_root_only(page):
    for language, code in BLOCK.findall(page.read_text(encoding="utf-8")):
        if language != "python":
            continue
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.Import):
                ours = [a for a in node.names if a.name.split(".")[0] == "lgrasp"]
                assert all((a.name, a.asname) == ("lgrasp", "lg") for a in ours)
            elif isinstance(node, ast.ImportFrom):
                assert (node.module or "").split(".")[0] != "lgrasp", node.module
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "lg":
                assert node.attr in lg.__all__


def test_page_of_python_runs(tmp_path, monkeypatch, cache_root):
    """Its blocks one after another, each printing what the page says."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LGRASP_CACHE_DIR", str(cache_root))
    blocks = BLOCK.findall((ROOT / "docs" / "guides" / "python.md").read_text(encoding="utf-8"))
    names: dict = {}
    said = None
    for language, code in blocks:
        if language == "text":
            assert said == code
            continue
        with contextlib.redirect_stdout(io.StringIO()) as out:
            exec(compile(code, "python.md", "exec"), names)
        said = out.getvalue()
    assert [path.name for path in tmp_path.iterdir()] == ["best.h5"]


def test_notebook_runs(tmp_path, monkeypatch, cache_root):
    """Its cells one after another, but for the one that installs; the last of them exports."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LGRASP_CACHE_DIR", str(cache_root))
    notebook = json.loads((ROOT / "docs" / "guides" / "first_grasps.ipynb").read_text(encoding="utf-8"))
    assert not any(cell.get("outputs") for cell in notebook["cells"])
    install, *cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert install.startswith("%pip install")
    names: dict = {}
    for code in cells:
        exec(compile(code.replace("n=40", "n=4"), "first_grasps.ipynb", "exec"), names)
    assert len(names["grasps"]) == 4
    assert any(Path("mug-isaac").iterdir())
