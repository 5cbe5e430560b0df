"""The ``lgrasp`` command: mounts the commands and turns every failure into one line and an exit code."""

import functools
import os
import sys
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any

import typer
from typer import Option
from typer.core import TyperGroup

from lgrasp.judge.__main__ import judge
from lgrasp.notices import on_notice
from lgrasp_cli import bench, cache, catalog, dataset, hands, learn, prepare, scenes
from lgrasp_cli.explain import explain
from lgrasp_cli.generate import generate
from lgrasp_cli.look import render, view
from lgrasp_cli.many import run
from lgrasp_cli.options import old_name, options_of, warn
from lgrasp_cli.plan import plan, refine
from lgrasp_cli.renamed import renew
from lgrasp_cli.sequence import sample, sequence
from lgrasp_cli.simulate import reach, simulate
from lgrasp_cli.status import status
from lgrasp_cli.submit import WORDS, submit

_PANELS = {
    "Generate": (generate, sequence, sample, plan, refine, run, submit),
    "Check": (simulate, reach, judge, status),
    "Look": (render, view, hands.app, catalog.objects, catalog.pipelines),
    "Data": (dataset.app, dataset.export, scenes.app),
    "Learn": (learn.app,),
    "Developer": (*prepare.COMMANDS, *prepare.STAGES, bench.app, cache.app),
}


class _Panels(TyperGroup):
    """Lists commands panel by panel."""

    def list_commands(self, ctx: Any) -> list[str]:
        place = {panel: number for number, panel in enumerate(_PANELS)}
        panels = {name: str(getattr(command, "rich_help_panel", "")) for name, command in self.commands.items()}
        return sorted(panels, key=lambda name: place.get(panels[name], len(place)))  # those of old names are hidden


app = typer.Typer(
    cls=_Panels,
    help="Generate grasps for dexterous hands.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for panel, members in _PANELS.items():
    for member in members:
        if isinstance(member, typer.Typer):
            app.add_typer(member, rich_help_panel=panel)
        else:
            app.command(rich_help_panel=panel, context_settings=WORDS if member is submit else None)(member)
app.command("validate", hidden=True)(old_name(simulate, "lgrasp validate", "lgrasp simulate"))


def _version(wanted: bool) -> None:
    if wanted:
        import lgrasp

        typer.echo(f"lgrasp {lgrasp.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[bool, Option("--version", callback=_version, is_eager=True, help="Print the version.")] = False,
) -> None:
    """Generate grasps for dexterous hands.

    A hand (URDF or MJCF) and an object (mesh) go in; collision-free grasps whose forces balance come out as HDF5 files.

    Example: lgrasp generate --object mug -n 10000
    """


@functools.cache
def program() -> Any:
    """All commands, built once."""
    return typer.main.get_command(app)


def main() -> None:
    """Run the command line; exit codes: 0 done, 2 bad input or output, 3 too few grasps, 130 interrupted, 141 nobody
    reads what it prints."""
    on_notice((lambda line: None) if "_LGRASP_COMPLETE" in os.environ else warn)  # a shell shows all
    sys.argv[1:] = renew(sys.argv[1:], options_of(program(), sys.argv[1:]))
    try:
        code = _exit_code()
        sys.stdout.flush()
    except BaseException as error:
        line, code = explain(error)
        if line and os.environ.get("LGRASP_DEBUG", "0") not in ("", "0"):
            sys.excepthook(type(error), error, error.__traceback__)
        _leave(line, code)
    sys.exit(code)


def _exit_code() -> int:
    """Run the command that the words name; its exit code."""
    _refuse_empty(["lgrasp", *sys.argv[1:]])
    code = program()(prog_name="lgrasp", standalone_mode=False)
    return code if isinstance(code, int) else 0


def _refuse_empty(words: Sequence[str]) -> None:
    """Refuse words without anything in them, which paths would take for the current folder."""
    from lgrasp.errors import ConfigError

    for before, word in pairwise(words):
        name, _, value = word.partition("=") if word.startswith("--") and "=" in word else (before, "", word)
        if not value:
            raise ConfigError(f"{name} '': empty; a name, a path or a number is accepted (is a variable not set?)")


def _leave(line: str, code: int) -> None:
    """Print a line on standard error and exit, whatever state the streams are in."""
    try:
        if line:
            sys.stderr.write(" ".join(line.split()) + "\n")
        sys.stderr.flush()
        sys.stdout.flush()
    except OSError:  # nobody reads: the interpreter must not try again
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
    sys.exit(code)
