"""Writes docs/reference/cli.md from the commands themselves: ``make docs``."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

import typer
from support.places import ROOT

_PAGE = ROOT / "docs" / "reference" / "cli.md"
_MANY = 2  # commands from which on an option is explained once for all
_MARK = "## Common options\n"
_JOB = ("--device", "--workers", "--array", "--overwrite", "--rebuild", "--json", "--cache-dir", "--quiet", "--verbose")
_Row = tuple[str, str, str]  # names, meaning, default and range of an option


def cli_page() -> str:
    """The page: its head as it is, then every command with its help and example; of those for users the options too."""
    from lgrasp_cli.main import app

    commands = list(_commands(typer.main.get_command(app), None, "lgrasp"))
    every = [row for command in commands for row in _options(*command)]
    counts, defaults = Counter(row[:2] for row in every), Counter(every)
    common: dict[str, _Row] = {}
    for (names, what), count in counts.most_common():
        if count >= _MANY and _flag(names) not in common:
            rows = [row for row, _ in defaults.most_common() if row[:2] == (names, what)]
            common[_flag(names)] = rows[0]
    lines = [
        _MARK,
        "Commands only name these options. Defaults are in brackets. `--help` says more about developer commands.",
        "",
    ]
    lines += [f"*Job options* are {_code(_JOB)}.", ""]
    lines += [*(f"- `{names}`: {what}{default}" for _, (names, what, default) in sorted(common.items())), ""]
    for command, context in commands:
        if not getattr(command, "commands", {}) or getattr(command, "invoke_without_command", False):
            lines += _section(command, context, _options(command, context), common)
        if context.command_path == "lgrasp run":
            lines += _config_keys(common)
    return _PAGE.read_text(encoding="utf-8").partition(_MARK)[0] + "\n".join(lines).rstrip() + "\n"


def _commands(command: Any, parent: typer.Context | None, name: str) -> Iterator[tuple[Any, typer.Context]]:
    """A command and those below it, each with its context."""
    context = typer.Context(command, info_name=name, parent=parent)
    yield command, context
    for below, sub in getattr(command, "commands", {}).items():
        if not sub.hidden:
            yield from _commands(sub, context, below)


def _options(command: Any, context: typer.Context) -> list[_Row]:
    """The options of a command for users; those of others are told by ``--help``."""
    if _panel(context) == "Developer":
        return []
    records = [p.get_help_record(context) for p in command.get_params(context) if "--help" not in p.opts]
    return [_row(names, what) for names, what in filter(None, records)]


def _row(names: str, what: str) -> _Row:
    """A line of a command's help, without types and ranges."""
    names = re.sub(r" <[^|]*>$", "", _line(names))
    what, *rest = re.split(r" (?=\[(?:default: |required|x[<>]|[\d.]+<)[^\[]*\]$)", _line(what))
    default = re.search(r"default: \(?([^;\])]*)|required", "".join(rest))
    return names, what, f" [{default[1] or default[0]}]" if default else ""


def _panel(context: Any) -> str:
    """The panel of ``lgrasp --help`` that names a command or the group that it is in."""
    above = context.parent
    return str(getattr(context.command, "rich_help_panel", "")) if not above or not above.parent else _panel(above)


def _code(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _flag(names: str) -> str:
    """--json of "-j, --json PATH"."""
    return names.split(", ")[-1].split()[0]


def _section(command: Any, context: typer.Context, rows: list[_Row], common: dict[str, _Row]) -> list[str]:
    """The part of one command."""
    text, _, example = (command.help or "").replace("\b", "").partition("Example: ")
    example, _, after = example.partition("\n\n")
    paragraphs = [_line(paragraph) for paragraph in f"{text}\n\n{after}".split("\n\n") if paragraph.strip()]
    lines = [f"## {context.command_path}", ""]
    for paragraph in paragraphs[: 1 if _panel(context) == "Developer" else None]:
        lines += [paragraph, ""]
    if len(example.split()) > len(context.command_path.split()) + 1:
        lines += [*(f"    {line.strip()}" for line in example.strip().splitlines()), ""]
    shared = [row for row in rows if row[:2] == common.get(_flag(row[0]), row[1:])[:2]]
    lines += [f"- `{names}`: {what}{default}" for names, what, default in rows if (names, what, default) not in shared]
    named = {_flag(row[0]): row[2] if row != common[_flag(row[0])] else "" for row in shared}
    words = [f"`{name}`{default}" for name, default in named.items() if not (name in _JOB and named.keys() >= {*_JOB})]
    words += ["job options"] if named.keys() >= {*_JOB} else []
    return [*lines, *([f"- [Common](#common-options): {', '.join(words)}."] if words else []), *([""] if rows else [])]


def _config_keys(common: dict[str, _Row]) -> list[str]:
    """The keys of a config, from its model; those that are options by name only."""
    from lgrasp.jobs.config import JobConfig

    fields = JobConfig.model_fields
    alike = [name for name, field in fields.items() if not field.description or f"--{name}" in common]
    lines = ["Keys of a config:", ""]
    for name, field in fields.items():
        default = field.get_default(call_default_factory=True)
        shown = ", ".join(default) if isinstance(default, tuple) else "" if default is None else str(default)
        if name not in alike:
            lines.append(f"- `{name}`: {_line(field.description or '')}" + (f" [{shown}]" if shown else ""))
    lines.append(f"- As the options: {_code(alike)}.")
    return [*lines, ""]


def _line(text: str) -> str:
    """Text on one line."""
    return " ".join(text.split())


if __name__ == "__main__":
    _PAGE.write_text(cli_page(), encoding="utf-8")
    typer.echo(_PAGE)
