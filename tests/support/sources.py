"""Source files of the project, parsed when a test first asks for them: collecting tests parses none."""

import ast
from functools import cache
from pathlib import Path


@cache
def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))
