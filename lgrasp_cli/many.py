"""Several jobs one after another: ``lgrasp run``, their progress, their plans, and one report of all."""

import threading
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from lgrasp.words import number
from lgrasp_cli.explain import explain
from lgrasp_cli.names import CONFIG, OBJECTS
from lgrasp_cli.options import DryRun, given
from lgrasp_cli.tables import TextTable, print_report
from lgrasp_cli.working import How, conclude, merely_checked, run_job, working

if TYPE_CHECKING:
    from lgrasp.engine.request import Request


def run_all(requests: "Sequence[Request]", how: How, *, dry_run: bool) -> None:
    """Run jobs, report them, and leave with the worst exit code; one that fails does not stop the others.

    Args:
        dry_run: show what would be done instead.
    """
    if merely_checked(requests, how.cache):
        return
    if dry_run:
        show_plans(requests, how)
        return
    from lgrasp.files import before_end  # not before something runs

    results: list[dict[str, Any]] = []

    once = threading.Lock()

    def interrupted() -> None:  # while a job loads, or by a second signal, which two threads may see
        if not once.acquire(blocking=False):
            return
        begun = map(_described, requests[len(results) : len(results) + 1])
        _report([*results, *(one | {"status": "interrupted", "error": "", "exit_code": 130} for one in begun)], how)

    stopped = False
    with closing(how.cache.kept), how.spread(requests) as each, before_end(interrupted):
        for number, (request, own) in enumerate(zip(requests, each, strict=True), 1):
            if not how.quiet:
                typer.echo(f"[{number}/{len(each)}] {request.title}", err=True)
            how.cache.more_jobs = number < len(each)
            result, stop = _run_one(request, own)
            results.append(result)
            if stop:
                stopped = number < len(each)
                break
    if code := _report(results, how, stopped=stopped):
        raise typer.Exit(code)


def _report(results: list[dict[str, Any]], how: How, *, stopped: bool = False) -> int:
    """Show what came of jobs; the worst exit code, or that of an interrupt if they were ``stopped``."""
    code = max(130 * stopped, *(result["exit_code"] for result in results))
    columns = ("job", "what", "requested", "rows", "wall s", "strict/s", "status")
    table = TextTable(columns, map(_row, results), right=columns[2:6])
    print_report({"jobs": results, "exit_code": code}, how.json_path, () if how.quiet else [table])
    return code


def _described(request: "Request") -> dict[str, Any]:
    return {"title": request.title, "unit": request.unit}


def show_plans(requests: "Sequence[Request]", how: How) -> None:
    """Print the plans of jobs, each with its own array task, and a line for each that would fail; leave with the worst
    exit code."""
    from lgrasp.errors import LgraspError
    from lgrasp.jobs.preview import PlanLine, preview

    found: dict[PlanLine, None] = {}
    code = 0
    for request, own in zip(requests, how.of_each(requests), strict=True):
        try:
            found |= dict.fromkeys(preview(own.checked(request), array=own.array, resume=not own.overwrite))
        except LgraspError as error:
            code = max(code, error.exit_code)
            typer.echo(f"error: {error}", err=True)
    table = TextTable(("what", "which", "state", "to do", "file"), list(found))
    print_report([line._asdict() for line in found], how.json_path, [table] if found else ())
    if code:
        raise typer.Exit(code)


def _run_one(request: "Request", how: How) -> tuple[dict[str, Any], bool]:
    """The report of a job with its status, one line of why, and exit code; and whether no other is to begin."""
    data = _described(request)
    status, text, code, stop = "done", "", 0, False
    try:
        job = how.checked(request)
        from lgrasp.engine.run import own_parts  # not before the check

        if how.array.total and not own_parts(job, how.array)[-1]:
            return data | {"status": "of other tasks", "error": text, "exit_code": code}, False
        found, outcome = run_job(job, how)
        data |= found
        stop = outcome.stopped
        conclude(outcome, how)
    except typer.Exit:
        status, code, stop = "interrupted", 130, True
    except Exception as error:  # also what nobody expects: the others do not end by it
        line, code = explain(error)
        if not line:  # nobody reads
            raise
        status, text = "starved" if code == 3 else "failed", line.removeprefix("error: ")
        typer.echo(line, err=True)
    return data | {"status": status, "error": text, "exit_code": code}, stop


def _row(result: dict[str, Any]) -> tuple[str, ...]:
    numbers = ["-"] * 4
    if "asked" in result:
        numbers[0] = f"{result['asked']:,}" if result["asked"] else "-"
        numbers[1:3] = f"{result['made'] + result['present']:,}", f"{result['seconds']['total']:.1f}"
        numbers[3] = number(result.get("strict_valid_per_s")) if result["made"] else "-"
    return (result["title"], result["unit"], *numbers, result["status"])


@working
def run(
    config: Annotated[str, Argument(help="Config file, or the name of a config.", **CONFIG)],
    how: How,
    rows: Annotated[int | None, Option("-n", "--rows", help="Replaces rows.")] = None,
    out: Annotated[Path | None, Option(help="Replaces out.")] = None,
    object_dir: Annotated[Path | None, Option(help="Replaces object_dir.")] = None,
    objects: Annotated[list[str] | None, Option("--object", help="Replaces objects; repeatable.", **OBJECTS)] = None,
    held_out: Annotated[list[str] | None, Option(help="Replaces held_out; repeatable.", **OBJECTS)] = None,
    seed: Annotated[int | None, Option(help="Replaces seed.")] = None,
    dry_run: DryRun = False,
) -> None:
    """Run the job of a config, or one job for every hand, object and pipeline that it names.

    Key 'job' tells what to do; without it, grasps are generated. A job that fails does not stop the others; the exit
    code is the worst one. Tasks of an array share the files of all jobs.

    Example: lgrasp run smoke
    """
    from lgrasp.jobs.config import load_requests

    changes = given(rows=rows, out=out, object_dir=object_dir, seed=seed, device=how.device, workers=how.workers)
    changes |= {key: value for key, value in (("objects", objects), ("held_out", held_out)) if value}
    asked = load_requests(config, changes)
    run_all(asked.requests, replace(how, devices=how.devices or asked.devices), dry_run=dry_run)
