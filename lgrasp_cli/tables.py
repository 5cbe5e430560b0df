"""Reports on standard output: lines, pairs and tables in aligned columns, which a terminal may make narrower."""

import json
import shlex
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import typer

from lgrasp.words import number, plural
from lgrasp_cli.options import JsonPath, check_report, with_options

_LEAST = 6  # characters that every column keeps


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
        if not isinstance(block, TextTable):  # commands and paths, which are copied, stay in one piece
            width = max(len(what) for what, _ in block)
            typer.echo("\n".join(f"{what:{width}}  {value}".rstrip() for what, value in block))
            continue
        rows = [block.columns, *block.rows]
        widths = _fitting([max(map(len, column)) for column in zip(*rows, strict=True)])
        sides = [">" if name in block.right else "<" for name in block.columns]
        for row in rows:
            for line in zip_longest(*map(_wrapped, row, widths), fillvalue=""):
                cells = [f"{cell:{side}{width}}" for cell, side, width in zip(line, sides, widths, strict=True)]
                typer.echo("  ".join(cells).rstrip())
    if json_path:
        from lgrasp.engine.report import write_json

        write_json(json_path, data)


def _fitting(widths: list[int]) -> list[int]:
    """Widths of columns with which a table fits the terminal: the widest ones give way."""
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else sys.maxsize
    room = max(width - 2 * (len(widths) - 1), _LEAST * len(widths))
    while sum(widths) > room:
        most, *others = sorted({*widths, _LEAST}, reverse=True)
        wide = [i for i, w in enumerate(widths) if w == most]
        down = min(most - others[0], -(-(sum(widths) - room) // len(wide)))
        widths = [w - down if i in wide else w for i, w in enumerate(widths)]
    return widths


def _wrapped(text: str, width: int) -> list[str]:
    """The lines of a cell, which breaks at spaces, or else anywhere."""
    return textwrap.wrap(text, width) if len(text) > width else [text]


def share(part: int | None, whole: int) -> str:
    """``12.5%``, or a dash of nothing."""
    return f"{part / whole:.1%}" if whole and part is not None else "-"


def counted(data: dict[str, Any], unit: str) -> str:
    """How much of the requested amount exists."""
    extra = f" ({data['present']:,} already present)" if data["present"] else ""
    return f"{data[unit]:,} of {data['asked']:,} requested{extra}"


def closed(data: dict[str, Any]) -> tuple[str, str]:
    """How many grasps have force closure."""
    return "force closure", number(data["force_closure"], ".1%")


def held(data: dict[str, Any]) -> list[tuple[str, str]]:
    """How many of the grasps that were simulated on the way hold; only those are in the files."""
    if not (counts := data["counts"].get("simulate")):
        return []
    return [("hold", f"all, in {data['protocol']}; {share(counts['held'], counts['tried'])} of those tried")]


def took(data: dict[str, Any], unit: str) -> list[tuple[str, str]]:
    """The time of a job, and how fast it was without loading and compiling."""
    seconds, made = data["seconds"], data["made"]
    rate = f"; {plural(made, unit[:-1])} in {seconds['parts']:.1f} s, {made / seconds['parts']:,.1f}/s" if made else ""
    return [("time", f"{seconds['total']:.1f} s{rate}")]


def following(command: str, path: Any, more: str = "") -> tuple[str, str]:
    """The command that one would run next on the files of a job."""
    return "next", f"lgrasp {command} {shlex.quote(str(path))}{more}"


def ending(data: dict[str, Any], unit: str, command: str = "") -> list[tuple[str, str]]:
    """The time of a job, where its shards are, and the command, if there is one, that one would run next on them."""
    where = ("where", f"{data['out']} ({plural(len(data['shards']), 'shard')})")
    return [*took(data, unit), where, *([following(command, data["out"])] if command else ())]


def checked(problems: dict[str, list[str]], unit: str) -> Answer:
    """The problems of each file, a line each on standard error; exit code 2 if there are any."""
    for path, lines in problems.items():
        for line in lines:
            typer.echo(f"{path}: {line}", err=True)
    if any(problems.values()):
        return Answer(problems, [], exit_code=2)
    return Answer(problems, [f"{plural(len(problems), unit)} valid"])
