"""Writes docs/reference/cli.md from the commands themselves: ``make docs``."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import typer

_PAGE = Path(__file__).parents[1] / "docs" / "reference" / "cli.md"
_MANY = 10  # commands from which on an option is listed once for all
_MARK = "## Common options\n"


def cli_page() -> str:
    """The page: its head as it is, then every command with its help, arguments and options."""
    from lgrasp_cli.main import app

    commands = list(_commands(typer.main.get_command(app), None, "lgrasp"))
    counts = Counter(row for command in commands for row in _options(*command))
    common: dict[str, str] = {}
    for (names, what), count in counts.most_common():
        if count >= _MANY and _flag(names) not in map(_flag, common):
            common[names] = what
    lines = [_MARK, "The commands below name these options without repeating their meaning.", ""]
    lines += [*_table(common.items()), ""]
    for command, context in commands:
        if context.parent is not None:
            lines += _section(command, context, common)
        if context.command_path == "lgrasp run":
            lines += _config_keys()
    return _PAGE.read_text(encoding="utf-8").partition(_MARK)[0] + "\n".join(lines).rstrip() + "\n"


def _commands(command: Any, parent: typer.Context | None, name: str) -> Iterator[tuple[Any, typer.Context]]:
    """A command and those below it, each with its context."""
    context = typer.Context(command, info_name=name, parent=parent)
    yield command, context
    for below, sub in getattr(command, "commands", {}).items():
        if not sub.hidden:
            yield from _commands(sub, context, below)


def _options(command: Any, context: typer.Context) -> list[tuple[str, str]]:
    """Names and help of the options of a command."""
    records = [p.get_help_record(context) for p in command.get_params(context) if "--help" not in p.opts]
    return [(_cell(names), _cell(what)) for names, what in filter(None, records)]


def _flag(names: str) -> str:
    """--json of "-j, --json PATH"."""
    return names.split(", ")[-1].split()[0]


def _table(rows: Iterable[tuple[str, str]]) -> list[str]:
    return ["| option | meaning |", "|---|---|", *(f"| `{names}` | {what} |" for names, what in rows)]


def _section(command: Any, context: typer.Context, common: dict[str, str]) -> list[str]:
    text, _, example = (command.help or "").replace("\b", "").partition("Example: ")
    lines = [f"## {context.command_path}", ""]
    for paragraph in filter(str.strip, text.split("\n\n")):
        lines += [" ".join(paragraph.split()), ""]
    if example:
        lines += ["```", example.strip(), "```", ""]
    rows = _options(command, context)
    if own := [row for row in rows if common.get(row[0]) != row[1]]:
        lines += [*_table(own), ""]
    if named := [f"`{_flag(names)}`" for names, what in rows if common.get(names) == what]:
        lines += [f"[Common options](#common-options): {', '.join(named)}.", ""]
    return lines


def _config_keys() -> list[str]:
    """The keys of a config, from its model."""
    from lgrasp.jobs.config import JobConfig

    lines = ["Keys of a config:", "", "| key | default | meaning |", "|---|---|---|"]
    for name, field in JobConfig.model_fields.items():
        default = field.get_default(call_default_factory=True)
        shown = ", ".join(default) if isinstance(default, tuple) else "" if default is None else str(default)
        lines.append(f"| `{name}` | {_cell(shown)} | {_cell(field.description or '')} |")
    return [*lines, ""]


def _cell(text: str) -> str:
    return re.sub(r"\s+", " ", text).replace("|", r"\|")


if __name__ == "__main__":
    _PAGE.write_text(cli_page(), encoding="utf-8")
    typer.echo(_PAGE)
