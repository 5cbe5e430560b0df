"""The ``lgrasp`` command: mounts the commands and turns every failure into one line and an exit code."""

import os
import sys
from typing import Annotated

import typer
from typer import Option

from lgrasp.judge.__main__ import judge
from lgrasp.notices import on_notice
from lgrasp_cli import bench, cache, catalog, dataset, hands, learn, prepare, scenes
from lgrasp_cli.generate import generate
from lgrasp_cli.options import old_name, warn
from lgrasp_cli.plan import plan
from lgrasp_cli.progress import Interrupted, on_interrupt, stop_asked, stop_now
from lgrasp_cli.refine import refine
from lgrasp_cli.renamed import renew
from lgrasp_cli.run import run
from lgrasp_cli.sequence import sequence
from lgrasp_cli.simulate import simulate

app = typer.Typer(
    help="Generate grasps for dexterous hands.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_jobs = (generate, sequence, plan, refine, run, simulate)
for command in (*prepare.COMMANDS, *_jobs, *prepare.STAGES, dataset.export, judge):
    app.command()(command)
app.command("validate", hidden=True)(old_name(simulate, "lgrasp validate", "lgrasp simulate"))
for group in (bench.app, hands.app, catalog.objects, catalog.pipelines, cache.app, dataset.app, scenes.app, learn.app):
    app.add_typer(group)


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

    A hand (URDF) and an object (mesh) go in, force-balanced collision-free grasps come out as HDF5 files.

    Example: lgrasp generate --object mug.obj -n 10000
    """


def main() -> None:
    """Run the command line; exit codes: 0 done, 2 bad input or output, 3 too few grasps, 130 interrupted."""
    on_notice(warn)
    sys.argv[1:] = renew(sys.argv[1:])
    if os.environ.get("LGRASP_DEBUG"):
        code = app(prog_name="lgrasp", standalone_mode=False)
        sys.exit(code if isinstance(code, int) else 0)
    try:
        with on_interrupt(stop_now):
            code = app(prog_name="lgrasp", standalone_mode=False)
            sys.stdout.flush()
    except BaseException as error:
        _leave(*_explain(error))
    sys.exit(code if isinstance(code, int) else 0)


def _explain(error: BaseException) -> tuple[str, int]:
    """One line for the user and the exit code of a failure."""
    from lgrasp.errors import LgraspError

    if stop_asked():
        return "interrupted", 130
    if isinstance(error, LgraspError):
        return f"error: {error}", error.exit_code
    if type(error).__name__ == "NoArgsIsHelpError":  # no command: its message, the help, is printed already
        return "", 2
    if isinstance(error, typer.TyperException):
        return f"error: {error.format_message()}", error.exit_code
    if isinstance(error, Interrupted | KeyboardInterrupt | typer.Abort):
        return "interrupted", 130
    if isinstance(error, SystemExit):
        return "", error.code if isinstance(error.code, int) else 1
    if isinstance(error, BrokenPipeError):
        return "", 141
    if isinstance(error, MemoryError) or "out of memory" in str(error).lower():
        return "error: out of memory; lower --workers or --batch, or choose fewer --shard-rows", 2
    if isinstance(error, OSError) and error.errno is not None:
        where = f"{error.filename}: " if error.filename else ""
        return f"error: {where}{error.strerror}", 2
    return f"error: unexpected {type(error).__name__}: {error} (set LGRASP_DEBUG=1 for the traceback)", 1


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
