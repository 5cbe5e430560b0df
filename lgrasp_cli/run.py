"""``lgrasp run``: jobs of any kind, from a config."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from lgrasp_cli.generate import show_plans
from lgrasp_cli.options import DryRun, check_report, given
from lgrasp_cli.tables import TextTable, print_report
from lgrasp_cli.working import How, conclude, run_job, working

if TYPE_CHECKING:
    from lgrasp.engine.run import Job


@working
def run(
    config: Annotated[str, Argument(help="Config file, or the name of a config.")],
    how: How,
    rows: Annotated[int | None, Option("-n", "--rows", help="Replaces rows.")] = None,
    out: Annotated[Path | None, Option(help="Replaces out.")] = None,
    object_dir: Annotated[Path | None, Option(help="Replaces object_dir.")] = None,
    seed: Annotated[int | None, Option(help="Replaces seed.")] = None,
    dry_run: DryRun = False,
) -> None:
    """Run the job of a config, or one job for every hand, object and pipeline that it names.

    Key 'job' names the command whose options the other keys are; without it grasps are generated. A job that fails does
    not stop the others; the exit code is the worst one.

    Example: lgrasp run configs/smoke.yaml
    """
    from lgrasp.jobs.config import load_jobs

    changes = given(rows=rows, out=out, object_dir=object_dir, seed=seed, device=how.device, workers=how.workers)
    tasks = [(job, how.rotated(number)) for number, job in enumerate(load_jobs(config, changes, how.cache))]
    if dry_run:
        show_plans(tasks, how)
        return
    check_report(how.json_path)
    results = []
    for number, (job, own) in enumerate(tasks, 1):
        if not how.quiet:
            typer.echo(f"[{number}/{len(tasks)}] {job.title}", err=True)
        results.append(_run_one(job, own))
        if results[-1]["exit_code"] == 130:
            break
    code = max(result["exit_code"] for result in results)
    columns = ("job", "what", "requested", "present", "wall s", "strict/s", "status")
    table = TextTable(columns, map(_row, results), right=columns[2:6])
    print_report({"jobs": results, "exit_code": code}, how.json_path, () if how.quiet else [table])
    if code:
        raise typer.Exit(code)


def _run_one(job: "Job", how: How) -> dict[str, Any]:
    """The report of a job with its status, one line of why, and exit code."""
    from lgrasp.errors import LgraspError
    from lgrasp_cli.progress import Interrupted

    data: dict[str, Any] = {"title": job.title, "unit": job.unit}
    status, text, code = "done", "", 0
    try:
        found, outcome = run_job(job, how)
        data |= found
        conclude(data, outcome)
    except LgraspError as error:
        status, text, code = "starved" if error.exit_code == 3 else "failed", str(error), error.exit_code
        typer.echo(f"error: {error}", err=True)
    except (MemoryError, OSError) as error:
        status, text, code = "failed", str(error), 2
        typer.echo(f"error: {error or 'out of memory'}", err=True)
    except (Interrupted, typer.Exit):
        status, code = "interrupted", 130
    return data | {"status": status, "error": text, "exit_code": code}


def _row(result: dict[str, Any]) -> tuple[str, ...]:
    if "asked" not in result:
        return (result["title"], result["unit"], "-", "-", "-", "-", result["status"])
    return (
        result["title"],
        result["unit"],
        f"{result['asked']:,}",
        f"{result['made'] + result['present']:,}",
        f"{result['seconds']['total']:.1f}",
        f"{result['strict_valid_per_s']:,.0f}" if "strict_valid_per_s" in result else "-",
        result["status"],
    )
