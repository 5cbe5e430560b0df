"""How kernels are written: few arguments, outputs last, shapes told."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.places import ROOT
from support.sources import parse

MOST_ARGUMENTS = 10

FILES = {
    path.relative_to(ROOT).with_suffix("").as_posix(): path
    for path in sorted((ROOT / "lgrasp").rglob("*.py"))
    if re.search(rb"@wp\.(kernel|struct)", path.read_bytes())
}


def decorated(path: Path, what: str) -> list[Any]:
    nodes = (n for n in ast.walk(parse(path)) if isinstance(n, ast.FunctionDef | ast.ClassDef))
    return [n for n in nodes if any(ast.unparse(d) == what for d in n.decorator_list)]


def is_array(annotation: ast.expr | None) -> bool:
    return annotation is not None and ast.unparse(annotation).startswith("wp.array")


@pytest.mark.parametrize("name", FILES)
def test_kernels(name):
    for kernel in decorated(FILES[name], "wp.kernel"):
        names = [a.arg for a in kernel.args.args]
        assert len(names) <= MOST_ARGUMENTS, f"{kernel.name}: {len(names)} arguments: put them into structs"
        outputs = [name.endswith("_out") for name in names]
        assert outputs == sorted(outputs), f"{kernel.name}: outputs come last"
        doc = ast.get_docstring(kernel) or ""
        assert doc, f"{kernel.name}: says nothing"
        for a in kernel.args.args:
            if is_array(a.annotation):
                described = re.search(rf"^ *{a.arg}: (.*(?:\n {{5,}}.*)*)", doc, re.MULTILINE)
                assert described, f"{kernel.name}: '{a.arg}' is not described"
                assert re.search(r"\(.*\)", described[1]), f"{kernel.name}: '{a.arg}' has no shape"


@pytest.mark.parametrize("name", FILES)
def test_structs(name):
    lines = FILES[name].read_text(encoding="utf-8").splitlines()
    for struct in decorated(FILES[name], "wp.struct"):
        for field in struct.body:
            if isinstance(field, ast.AnnAssign) and is_array(field.annotation):
                comment = lines[field.lineno - 1].partition("#")[2]
                assert re.search(r"\(.*\)", comment), f"{struct.name}: '{ast.unparse(field.target)}' has no shape"


MADE = {"array", "empty", "zeros", "ones", "full", "launch", "launch_tiled", "HashGrid"}
ON_ONE_THREAD = {"lgrasp/simulate/worlds.py", "lgrasp/simulate/noslip.py"}
"""MuJoCo Warp goes by the default device."""


def host_calls(node: ast.AST) -> Iterator[ast.Call]:
    """Calls outside kernels, functions of kernels, and annotations."""
    if any(ast.unparse(d).startswith(("wp.kernel", "wp.func")) for d in getattr(node, "decorator_list", ())):
        return
    if isinstance(node, ast.Call):
        yield node
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if name != "annotation" and isinstance(child, ast.AST):
                yield from host_calls(child)


def test_device_is_named():
    """Threads share Warp's default device: one that changes it for a while makes others launch elsewhere."""
    for path in (ROOT / "lgrasp").rglob("*.py"):
        if (name := path.relative_to(ROOT).as_posix()) in ON_ONE_THREAD:
            continue
        for call in host_calls(parse(path)):
            what = ast.unparse(call.func)
            assert what not in ("wp.ScopedDevice", "wp.set_device"), f"{name}:{call.lineno}"
            if what in {f"wp.{made}" for made in MADE} and call.args:  # without any it is a type
                assert any(k.arg in ("device", None) for k in call.keywords), f"{name}:{call.lineno} {what}"
