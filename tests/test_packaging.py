"""The shape of the project: exported names, direction of imports, content of the wheel."""

import ast
import subprocess
import zipfile
from collections import Counter
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from support.places import ROOT
from support.sources import parse

DATA = ("hands", "objects", "pipelines", "configs", "models")

ORDER = (
    ("errors", "files", "outputs", "paths", "notices", "choices", "config", "seeding", "signals", "words"),
    ("geometry", "math", "runtime"),
    ("hand", "object"),
    ("cloud", "differentiable", "field"),
    ("grasp",),
    ("picture",),
    ("simulate", "dataset", "refine"),
    ("planning", "scenes", "hold", "steer", "policy", "reach"),
    ("stages",),
    ("sequence", "learn"),
    ("engine",),
    ("jobs",),
    ("bench", "api", "view"),
)
"""Rooms of lgrasp from the lowest floor up; a room imports rooms of its own floor or below, without a cycle."""

FLOOR = {room: floor for floor, rooms in enumerate(ORDER) for room in rooms}
ALONE = {"judge"}
"""Rooms that import nothing of lgrasp and are imported by the command line and the root only."""


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {
    module_name(path): path
    for package in ("lgrasp", "lgrasp_cli")
    for path in sorted((ROOT / package).rglob("*.py"))
    if "_data" not in path.parts
}
PACKAGES = {name for name, path in MODULES.items() if path.name == "__init__.py"}
LEAVES = sorted(set(MODULES) - PACKAGES)


def exported(name: str) -> list[str]:
    """``__all__`` of a package; of a module every definition whose name does not begin with an underscore."""
    if name not in PACKAGES:
        return [x for x in defined(name) if not x.startswith("_")]
    for node in parse(MODULES[name]).body:
        if isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets):
            return list(ast.literal_eval(node.value))
    return []


@cache
def defined(name: str) -> dict[str, ast.stmt]:
    """Top-level names that a module defines itself, imports left out."""
    found = {}
    for node in parse(MODULES[name]).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found[node.name] = node
        elif isinstance(node, ast.Assign):
            targets = [x for t in node.targets for x in (t.elts if isinstance(t, ast.Tuple) else [t])]
            found |= {t.id: node for t in targets if isinstance(t, ast.Name)}
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found[node.target.id] = node
    return found


@cache
def imports(name: str) -> list[tuple[str, str, int]]:
    """Every import of this project in a module, at any depth: (module, imported name or "", line)."""
    found = []
    package = name if name in PACKAGES else name.rpartition(".")[0]
    for node in ast.walk(parse(MODULES[name])):
        if isinstance(node, ast.Import):
            found += [(alias.name, "", node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*above, *([base] if base else [])])
            found += [(base, alias.name, node.lineno) for alias in node.names]
    return [x for x in found if x[0].split(".")[0] in ("lgrasp", "lgrasp_cli")]


def resolved(name: str) -> list[tuple[str, int]]:
    """Modules of this project that a module imports; ``from a import b`` is ``a.b`` where that is a module."""
    return [(f"{base}.{what}" if f"{base}.{what}" in MODULES else base, line) for base, what, line in imports(name)]


def room(name: str) -> str:
    """``lgrasp.hand.model`` -> ``hand``; ``lgrasp`` -> ``""``."""
    return [*name.split("."), ""][1]


@pytest.mark.parametrize("name", sorted(PACKAGES))
def test_package_only_re_exports(name):
    own = set(defined(name)) - {"__all__"}
    allowed = {"__version__", "_HOMES", "_HOME", "_Face"} if name == "lgrasp" else set()
    assert own - {"__getattr__", "__dir__"} <= allowed, f"{name}/__init__.py defines {sorted(own - allowed)}"
    sources = {what: base for base, what, _ in imports(name)}
    for symbol in exported(name) or []:
        if symbol in sources:
            is_module = f"{sources[symbol]}.{symbol}" in MODULES
            listed = symbol in (exported(sources[symbol]) or [])
            assert is_module or listed, f"{name} re-exports {symbol}, not in {sources[symbol]}.__all__"
        else:  # a lazy re-export, or a submodule
            lazy = "__getattr__" in own or f"{name}.{symbol}" in MODULES
            assert symbol in allowed or lazy, f"{name}.__all__ lists {symbol}, which it does not import"


def test_classes_have_one_home():
    homes = Counter(
        symbol
        for name in LEAVES
        for symbol in exported(name) or []
        if isinstance(defined(name).get(symbol), ast.ClassDef)
    )
    assert not [symbol for symbol, count in homes.items() if count > 1]


@pytest.mark.parametrize("name", sorted(MODULES))
def test_imports_run_one_way(name):
    if name.startswith("lgrasp_cli") or name == "lgrasp":
        return  # the command line may import all of lgrasp; lgrasp/__init__.py may re-export any of it
    here = room(name)
    assert here in FLOOR or here in ALONE, f"{name}: '{here}' has no place in the order; see ORDER"
    for target, line in resolved(name):
        where = f"{name}:{line} imports {target}"
        assert not target.startswith("lgrasp_cli"), where
        there = room(target)
        if there in (here, ""):
            continue
        assert not {here, there} & ALONE, f"{where}: {sorted({here, there} & ALONE)} stand alone"
        assert FLOOR[there] <= FLOOR[here], f"{where}, against the order"
        if here == there == "stages":
            stage, other = (x.split(".")[2:3] for x in (name, target))
            shared = not other or f"lgrasp.stages.{other[0]}" not in PACKAGES
            assert stage == other or shared or not stage, f"{where}: stages never import stages"


def test_engine_knows_no_feature():
    """What all jobs share imports none of them and stays small; stages are imported by name when they are used."""
    own = [name for name in MODULES if room(name) == "engine"]
    assert len(own) <= 16, sorted(own)
    features = {"jobs", "sequence", "scenes", "learn", "refine", "planning", "simulate"}
    found = [f"{name}:{line} {target}" for name in own for target, line in resolved(name) if room(target) in features]
    assert not found


def folder(name: str) -> str:
    """The folder that a module lies in; a package's own face lies in the package."""
    return name if name in PACKAGES else name.rpartition(".")[0]


@pytest.mark.parametrize("unit", [str, folder], ids=["files", "folders"])
def test_no_cycle(unit):
    """Neither between files nor between folders, those inside a room included; the root's face is left out."""
    after: dict[str, set[str]] = {}
    for name in MODULES:
        if name != "lgrasp":
            targets = {unit(target) for target, _ in resolved(name)} - {"lgrasp"}
            after.setdefault(unit(name), set()).update(targets - {unit(name)})
    try:
        list(TopologicalSorter(after).static_order())
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_data_folders_hold_no_python():
    assert not [p for kind in DATA for p in (ROOT / kind).rglob("*.py")]


@pytest.mark.parametrize("chromium", ["", "/usr/bin/chromium"])
def test_playwright_is_installed_where_chromium_is(chromium):
    command = ["make", "--dry-run", "--always-make", "setup", f"CHROMIUM={chromium}"]
    told = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    for words in ("playwright", "greenlet", "dev,sim,browser"):
        assert (words in told) is bool(chromium)


def test_wheel_carries_the_data(tmp_path):
    wheel_builder = pytest.importorskip("hatchling.builders.wheel").WheelBuilder(str(ROOT))
    (wheel,) = wheel_builder.build(directory=str(tmp_path), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    tops = {name.split("/")[0] for name in names}
    assert {x for x in tops if not x.endswith(".dist-info")} == {"lgrasp", "lgrasp_cli"}
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)
    for kind in DATA:
        for path in (ROOT / kind).rglob("*"):
            ignored = path.name.startswith(".") or "__pycache__" in path.parts
            if path.is_file() and not ignored:
                assert f"lgrasp/_data/{path.relative_to(ROOT).as_posix()}" in names
    assert any(name.startswith("lgrasp/_data/hands/allegro/") for name in names)
