"""``lgrasp run`` with a config of sequences: many object sets in several orders."""

from typing import TYPE_CHECKING, Any

import typer

from lgrasp_cli.interrupt import Interrupted
from lgrasp_cli.options import check_report

if TYPE_CHECKING:
    from lgrasp.jobs.sequence.job import SequenceJob


def run_sets(jobs: "list[SequenceJob]", json_path: str | None, *, dry_run: bool, quiet: bool) -> None:
    """Run the jobs one after another; one that fails does not stop the others.

    Raises:
        Exit: with the worst exit code, if it is not 0.
    """
    from lgrasp_cli.tables import print_report, print_table

    if dry_run:
        print_table(("objects", "sequences", "folder"), [(_names(j), f"{j.rows:,}", str(j.out)) for j in jobs])
        return
    check_report(json_path)
    results = []
    for number, job in enumerate(jobs, 1):
        if not quiet:
            typer.echo(f"[{number}/{len(jobs)}] {job.hand} {_names(job)}", err=True)
        results.append(_run_one(job, quiet))
        if results[-1]["exit_code"] == 130:
            break
    code = max((result["exit_code"] for result in results), default=0)
    print_report({"jobs": results, "exit_code": code}, json_path, None if quiet else lambda: _show(results))
    if code:
        raise typer.Exit(code)


def _names(job: "SequenceJob") -> str:
    from pathlib import Path

    return " ".join(Path(name).stem for name in job.objects)


def _run_one(job: "SequenceJob", quiet: bool) -> dict[str, Any]:
    from lgrasp.errors import LgraspError
    from lgrasp_cli.sequence import conclude, run_sequences

    data: dict[str, Any] = {"hand": job.hand, "objects": list(job.objects)}
    try:
        found, outcome = run_sequences(job, quiet=quiet)
        data |= found
        conclude(found, outcome)
    except LgraspError as error:
        typer.echo(f"error: {error}", err=True)
        status = "starved" if error.exit_code == 3 else "failed"
        return data | {"status": status, "error": str(error), "exit_code": error.exit_code}
    except (Interrupted, typer.Exit):
        return data | {"status": "interrupted", "error": "", "exit_code": 130}
    return data | {"status": "done", "error": "", "exit_code": 0}


def _show(results: list[dict[str, Any]]) -> None:
    from lgrasp_cli.tables import print_table

    columns = ("hand", "objects", "sequences", "reached", "wall s", "status")
    print_table(columns, [_row(result) for result in results], right=("sequences", "wall s"))


def _row(result: dict[str, Any]) -> tuple[str, ...]:
    from pathlib import Path

    names = " ".join(Path(name).stem for name in result["objects"])
    if "sequences" not in result:
        return (Path(result["hand"]).stem, names, "-", "-", "-", result["status"])
    return (
        result["hand"],
        names,
        f"{result['sequences']:,}",
        " ".join(f"{count:,}" for count in result["reached"]),
        f"{result['seconds']['total']:.1f}",
        result["status"],
    )
