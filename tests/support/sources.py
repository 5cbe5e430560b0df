"""Source files of the project, parsed when a test first asks for them: collecting tests parses none."""

import ast
from functools import cache
from pathlib import Path

from support.places import ROOT


@cache
def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def modules_with(*words: str) -> list[Path]:
    """The modules of the project in whose text any of some words is."""
    found = (*ROOT.glob("lgrasp/**/*.py"), *ROOT.glob("lgrasp_cli/**/*.py"))
    return [path for path in found if any(word in path.read_text(encoding="utf-8") for word in words)]
