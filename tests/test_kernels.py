"""How kernels are written: few arguments, outputs last, shapes told."""

import ast
import re
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
