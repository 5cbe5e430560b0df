"""Reports on standard output: lines, pairs and tables in aligned columns, the same on a terminal and in a file."""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import typer

from lgrasp_cli.options import JsonPath, check_report, with_options


@dataclass(frozen=True)
class TextTable:
    """A table with a header line."""

    columns: Sequence[str]
    rows: Iterable[Sequence[str]]
    right: Sequence[str] = ()
    """Columns of numbers."""


Block = str | TextTable | list[tuple[str, str]]
"""A line, a table, or pairs of what and value."""


@dataclass(frozen=True)
class Answer:
    """What a command found."""

    data: Any
    """JSON-serialisable."""
    blocks: Sequence[Block]
    """The same to be read."""
    exit_code: int = 0


def reporting(command: Callable[..., Answer]) -> Callable[..., None]:
    """A command that returns its report: it gets ``--json``, and the report is printed and written as that says."""

    def run(*, json_path: JsonPath = None, **options: Any) -> None:
        check_report(json_path)
        report = command(**options)
        print_report(report.data, json_path, report.blocks)
        if report.exit_code:
            raise typer.Exit(report.exit_code)

    return with_options(run, command)


def print_report(data: Any, json_path: str | None, blocks: Iterable[Block]) -> None:
    """A report as --json says: to standard output for -, else shown, and written to the path if there is one."""
    if json_path == "-":
        typer.echo(json.dumps(data, indent=2))
        return
    for block in blocks:
        if isinstance(block, str):
            typer.echo(block)
            continue
        rows: list[Any] = [block.columns, *block.rows] if isinstance(block, TextTable) else block
        right = {i for i, n in enumerate(block.columns) if n in block.right} if isinstance(block, TextTable) else set()
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        for row in rows:
            cells = [c.rjust(w) if i in right else c.ljust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))]
            typer.echo("  ".join(cells).rstrip())
    if json_path:
        from lgrasp.engine.report import write_json

        write_json(json_path, data)


def plural(n: int, what: str) -> str:
    """A number of things: ``1 shard``, ``2 shards``."""
    return f"{n:,} {what}{'' if n == 1 else 's'}"


def share(part: int, whole: int) -> str:
    """``12.5%``, or a dash of nothing."""
    return f"{part / whole:.1%}" if whole else "-"


def counted(data: dict[str, Any], unit: str) -> str:
    """How much of the requested amount exists."""
    extra = f" ({data['present']:,} already present)" if data["present"] else ""
    return f"{data[unit]:,} of {data['asked']:,} requested{extra}"


def place(data: dict[str, Any]) -> tuple[str, str]:
    """Where the shards of a job are."""
    return "where", f"{data['out']} ({plural(len(data['shards']), 'shard')})"


def checked(problems: dict[str, list[str]], unit: str) -> Answer:
    """The problems of each file, a line each on standard error; exit code 2 if there are any."""
    for path, lines in problems.items():
        for line in lines:
            typer.echo(f"{path}: {line}", err=True)
    if any(problems.values()):
        return Answer(problems, [], exit_code=2)
    return Answer(problems, [f"{plural(len(problems), unit)} valid"])
