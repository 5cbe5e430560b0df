"""The shape of the project: exported names, direction of imports, start-up cost, content of the wheel."""

import ast
import subprocess
import sys
import zipfile
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HEAVY = ("torch", "warp", "trimesh", "yourdfpy", "h5py", "scipy", "numpy", "coacd", "pytorch_kinematics")
DATA = ("hands", "objects", "pipelines", "configs")

SHARED = {"clusters", "config", "decompose", "errors", "paths", "seeding"}
"""Modules of lgrasp that everything may import; they import one another only."""

MAY_IMPORT = {
    "device": set(),
    "hand": {"device"},
    "object": {"device"},
    "differentiable": {"device", "hand", "object"},
    "field": {"device", "hand", "object"},
    "grasp": {"device", "hand", "object"},
    "dataset": {"device", "hand", "object", "field", "grasp"},
    "physics": {"device", "hand", "object", "dataset"},
    "refine": {"device", "hand", "object", "differentiable", "grasp"},
    "scenes": {"device", "hand", "object", "grasp", "dataset", "physics"},
    "learn": {"device", "hand", "object", "differentiable", "dataset", "refine", "scenes"},
    "stages": {"device", "hand", "object", "field", "grasp", "differentiable", "dataset", "physics", "refine"},
    "engine": {
        "device",
        "hand",
        "object",
        "field",
        "grasp",
        "differentiable",
        "stages",
        "dataset",
        "physics",
        "refine",
        "scenes",
        "learn",
    },
}
"""The packages of lgrasp, each with those it may import besides itself and the shared modules."""


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {
    module_name(path): path
    for package in ("lgrasp", "lgrasp_cli")
    for path in sorted((ROOT / package).rglob("*.py"))
    if "_data" not in path.parts
}
TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in MODULES.items()}
PACKAGES = {name for name, path in MODULES.items() if path.name == "__init__.py"}
LEAVES = sorted(set(MODULES) - PACKAGES)


def exported(name: str) -> list[str] | None:
    """The literal ``__all__`` of a module, or None when it has none."""
    for node in TREES[name].body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(t, ast.Name) and t.id == "__all__" for t in targets):
            return list(ast.literal_eval(node.value))
    return None


def defined(name: str) -> dict[str, ast.stmt]:
    """Top-level names that a module defines itself, imports left out."""
    found = {}
    for node in TREES[name].body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found[node.name] = node
        elif isinstance(node, ast.Assign):
            targets = [x for t in node.targets for x in (t.elts if isinstance(t, ast.Tuple) else [t])]
            found |= {t.id: node for t in targets if isinstance(t, ast.Name)}
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found[node.target.id] = node
    return found


def is_registered(node: ast.stmt) -> bool:
    """Whether a decorator hands a definition to Warp or to the command line; it needs no export then."""
    decorators = [ast.unparse(d).split("(")[0] for d in getattr(node, "decorator_list", [])]
    return any(d.startswith("wp.") or d.endswith((".command", ".callback")) for d in decorators)


def imports(name: str) -> list[tuple[str, str, int]]:
    """Every import of this project in a module, at any depth: (module, imported name or "", line)."""
    found = []
    package = name if name in PACKAGES else name.rpartition(".")[0]
    for node in ast.walk(TREES[name]):
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


@pytest.mark.parametrize("name", LEAVES)
def test_module_exports_what_it_defines(name):
    names = exported(name)
    assert names is not None, f"{name} has no __all__"
    assert names == sorted(set(names), key=names.index), f"{name}: a name twice in __all__"
    own = defined(name)
    foreign = [x for x in names if x not in own]
    assert not foreign, f"{name}.__all__ lists what the module does not define: {foreign}"
    public = [
        x
        for x, node in own.items()
        if not x.startswith("_")
        and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
        and not is_registered(node)
    ]
    hidden = [x for x in public if x not in names]
    assert not hidden, f"{name}: public by name but not in __all__ (list it or start it with _): {hidden}"


@pytest.mark.parametrize("name", sorted(PACKAGES))
def test_package_only_re_exports(name):
    own = set(defined(name)) - {"__all__"}
    allowed = {"__version__"} if name == "lgrasp" else set()
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
    assert here in SHARED or here in MAY_IMPORT, f"{name}: '{here}' has no place in the order; see MAY_IMPORT"
    for target, line in resolved(name):
        where = f"{name}:{line} imports {target}"
        assert not target.startswith("lgrasp_cli"), where
        there = room(target)
        if there in SHARED or there == "":
            continue
        assert here not in SHARED, f"{where}, but {here} is imported by everything"
        assert there == here or there in MAY_IMPORT[here], f"{where}, against the order"
        if here == there == "stages":
            stage, other = (x.split(".")[2:3] for x in (name, target))
            shared = not other or f"lgrasp.stages.{other[0]}" not in PACKAGES
            assert stage == other or shared or not stage, f"{where}: stages never import stages"


def test_no_cycle_between_packages():
    """The order itself is one: a package may import only packages that may not import it."""
    for here, below in MAY_IMPORT.items():
        assert all(here not in MAY_IMPORT[there] for there in below)


def test_data_folders_hold_no_python():
    assert not [p for kind in DATA for p in (ROOT / kind).rglob("*.py")]


@pytest.mark.skipif("lgrasp_cli.main" not in MODULES, reason="lgrasp_cli/main.py does not exist yet")
def test_command_line_starts_light():
    code = f"import sys, lgrasp_cli.main; print([m for m in {HEAVY} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert result.stdout.strip() == "[]"


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
