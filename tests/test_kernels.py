"""How kernels are written: few arguments, outputs last, shapes told."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MOST_ARGUMENTS = 10


def decorated(tree: ast.Module, what: str) -> list[ast.FunctionDef | ast.ClassDef]:
    nodes = (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.ClassDef))
    return [n for n in nodes if any(ast.unparse(d) == what for d in n.decorator_list)]


MODULES = {
    path.relative_to(ROOT).with_suffix("").as_posix(): path.read_text(encoding="utf-8")
    for path in sorted((ROOT / "lgrasp").rglob("*.py"))
}
KERNELS = [
    pytest.param(kernel, id=f"{name}:{kernel.name}")
    for name, text in MODULES.items()
    for kernel in decorated(ast.parse(text), "wp.kernel")
]
STRUCTS = [
    pytest.param(struct, text.splitlines(), id=f"{name}:{struct.name}")
    for name, text in MODULES.items()
    for struct in decorated(ast.parse(text), "wp.struct")
]


def is_array(annotation: ast.expr | None) -> bool:
    return annotation is not None and ast.unparse(annotation).startswith("wp.array")


@pytest.mark.parametrize("kernel", KERNELS)
def test_kernels(kernel):
    names = [a.arg for a in kernel.args.args]
    assert len(names) <= MOST_ARGUMENTS, f"{len(names)} arguments: put them into structs"
    outputs = [name.endswith("_out") for name in names]
    assert outputs == sorted(outputs), "outputs come last"
    doc = ast.get_docstring(kernel) or ""
    assert doc, "says nothing"
    for a in kernel.args.args:
        if is_array(a.annotation):
            described = re.search(rf"^ *{a.arg}: (.*(?:\n {{5,}}.*)*)", doc, re.MULTILINE)
            assert described, f"'{a.arg}' is not described"
            assert re.search(r"\(.*\)", described[1]), f"'{a.arg}' has no shape"


@pytest.mark.parametrize(("struct", "lines"), STRUCTS)
def test_structs(struct, lines):
    for field in struct.body:
        if isinstance(field, ast.AnnAssign) and is_array(field.annotation):
            comment = lines[field.lineno - 1].partition("#")[2]
            assert re.search(r"\(.*\)", comment), f"'{ast.unparse(field.target)}' has no shape"
