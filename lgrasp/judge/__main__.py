"""The command ``judge``, of ``lgrasp`` and as ``python -m lgrasp.judge SHARDS...``."""

import json
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

_PLAIN_INTERVAL = 10.0  # [s] between lines of progress where standard error is no terminal
_CLEAR = "\r\033[K"  # of a terminal: the line is empty


def judge(
    shards: Annotated[
        list[Path], typer.Argument(metavar="SHARDS", help="Shard files, or folders; subfolders are searched.")
    ],
    rows: Annotated[int | None, typer.Option(help="Judge this many rows, drawn at random; default: all.")] = None,
    urdf: Annotated[Path | None, typer.Option(help="Original URDF in place of the stored one.")] = None,
    mesh: Annotated[
        list[str] | None, typer.Option(help="Original mesh in place of the stored one, PATH or ID=PATH; repeatable.")
    ] = None,
    json_path: Annotated[
        str | None,
        typer.Option("--json", metavar="PATH", help="Also write the findings as JSON; - prints them instead."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress and no report, only errors.")] = False,
) -> None:
    """Judge every row of shards by the strict bounds, from the URDF and the meshes alone.

    It shares no code with the generator and trusts no stored number. Rows marked invalid are counted separately.

    Exit code: 0 if every row is strictly valid, 1 if not, 2 if some file cannot be judged.

    \b
    Example: lgrasp judge grasps
    lgrasp judge grasps --rows 1000 --json verdict.json
    lgrasp judge mug.h5 --urdf allegro.urdf --mesh mug=mug.obj
    """
    from lgrasp.judge.bounds import JudgeError

    meshes: dict[str, str | Path] = {}
    for given in mesh or ():
        name, sign, file = given.partition("=")
        meshes |= {name: file} if sign else {"": given}
    try:
        from lgrasp.judge.files import check_report, existing, find_shards, write_report

        if json_path and json_path != "-":
            check_report(json_path)
        files = len(find_shards(shards))
        for path in (*meshes.values(), *([urdf] if urdf else ())):
            existing(path)
        from lgrasp.judge import run

        progress = None if quiet else _Progress()
        try:
            report = run.judge(shards, urdf=urdf, mesh=meshes or None, rows=rows, progress=progress)
        finally:
            if progress:
                progress.close()
        text = json.dumps(report.to_dict(), indent=1, allow_nan=False)
        if json_path and json_path != "-":
            write_report(json_path, text + "\n")
    except JudgeError as error:
        typer.echo(f"error: {' '.join(str(error).split())}", err=True)
        raise typer.Exit(2) from error
    except OSError as error:
        typer.echo(f"error: {error.filename or json_path}: {error.strerror}", err=True)
        raise typer.Exit(2) from error
    if out := report.left_out:
        typer.echo(f"warning: {len(out)} of {files} files are left out, first {' '.join(out[0].split())}", err=True)
    if json_path == "-":
        typer.echo(text)
    elif not quiet:
        typer.echo(str(report))
    raise typer.Exit(2 if report.left_out else 0 if report.passed else 1)


class _Progress:
    """Rows judged so far on standard error: rewritten on a terminal, else a line every ten seconds."""

    def __init__(self) -> None:
        self._live = sys.stderr.isatty()
        self._start = self._said = 0.0  # until it is called

    def __call__(self, done: int, total: int) -> None:
        now = time.monotonic()
        if not self._start:
            self._start = self._said = now
        if now - self._said < (0.2 if self._live else _PLAIN_INTERVAL):
            return
        self._said = now
        line = f"judging {done:,}/{total:,} rows, {done / (now - self._start):,.0f}/s"
        typer.echo(f"{_CLEAR}{line}" if self._live else line, err=True, nl=not self._live)

    def close(self) -> None:
        """Clear the line on a terminal, where the report follows."""
        if self._live:
            typer.echo(_CLEAR, err=True, nl=False)


if __name__ == "__main__":
    typer.run(judge)
