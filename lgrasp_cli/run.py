"""``lgrasp run``: many hands and objects, from a config."""

from pathlib import Path
from typing import Annotated, Any

import typer

from lgrasp_cli.options import CacheDir, JsonPath, Quiet, check_report, open_cache


def register(app: typer.Typer) -> None:
    """Mount the commands of this file."""
    app.command()(run)


def run(
    config: Annotated[str, typer.Argument(help="Config file, or the name of a config.")],
    rows: Annotated[int | None, typer.Option("-n", "--rows", help="Replaces rows.", show_default=False)] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Replaces out.", show_default=False)] = None,
    object_dir: Annotated[Path | None, typer.Option(help="Replaces object_dir.", show_default=False)] = None,
    device: Annotated[str | None, typer.Option(help="Replaces device.", show_default=False)] = None,
    workers: Annotated[int | None, typer.Option(help="Replaces workers.", show_default=False)] = None,
    seed: Annotated[int | None, typer.Option(help="Replaces seed.", show_default=False)] = None,
    resume: Annotated[bool, typer.Option("--resume/--no-resume", help="Keep whole shards of the same run.")] = True,
    shard_index: Annotated[
        int | None, typer.Option(help="Task of an array; default: SLURM_ARRAY_TASK_ID.", show_default=False)
    ] = None,
    num_shards: Annotated[
        int | None, typer.Option(help="Tasks of the array; default: SLURM_ARRAY_TASK_COUNT.", show_default=False)
    ] = None,
    json_path: JsonPath = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what would be computed; change nothing.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Make hands, objects, fields and shards anew.")] = False,
    cache_dir: CacheDir = None,
    quiet: Quiet = False,
) -> None:
    """Generate grasps for every hand, object and pipeline of a config.

    A job that fails does not stop the others; the exit code is the worst one.

    Example: lgrasp run configs/smoke.yaml
    """
    cache = open_cache(cache_dir, fresh=force)
    from lgrasp.config import parse_model
    from lgrasp.jobs.config import JobConfig, array_task, load_config, plan_jobs, plan_sequences
    from lgrasp_cli.seqset import run_sets

    changes = {
        "rows": rows, "out": out, "object_dir": object_dir, "device": device, "workers": workers, "seed": seed
    }  # fmt: skip
    given = {name: value for name, value in changes.items() if value is not None}
    chosen = parse_model(JobConfig, load_config(config).model_dump() | given, f"config {config}")
    task, keep = array_task(shard_index, num_shards), resume and not force
    if chosen.sequences:
        run_sets(plan_sequences(chosen, cache, array=task, resume=keep), json_path, dry_run=dry_run, quiet=quiet)
        return
    jobs = plan_jobs(chosen, cache, array=task, resume=keep)
    if dry_run:
        _show_plans(jobs)
        return
    check_report(json_path)
    results = []
    for number, job in enumerate(jobs, 1):
        if not quiet:
            typer.echo(f"[{number}/{len(jobs)}] {job.hand} {job.object} {job.pipeline.name}", err=True)
        results.append(_run_one(job, quiet))
        if results[-1]["exit_code"] == 130:
            break
    code = max(result["exit_code"] for result in results)
    from lgrasp_cli.tables import print_report

    print_report({"jobs": results, "exit_code": code}, json_path, None if quiet else lambda: _show(results))
    if code:
        raise typer.Exit(code)


def _run_one(job: Any, quiet: bool) -> dict[str, Any]:
    """The report of a job with its status, one line of why, and exit code."""
    from lgrasp.errors import LgraspError
    from lgrasp_cli.generate import conclude, run_job
    from lgrasp_cli.interrupt import Interrupted

    base = {"hand": job.hand, "object": job.object, "pipeline": job.pipeline.name}
    data: dict[str, Any] = {}
    try:
        data, outcome = run_job(job, quiet=quiet)
        conclude(data, outcome)
    except LgraspError as error:
        status = "starved" if error.exit_code == 3 else "failed"
        typer.echo(f"error: {error}", err=True)
        return base | data | {"status": status, "error": str(error), "exit_code": error.exit_code}
    except (MemoryError, OSError) as error:
        typer.echo(f"error: {error or 'out of memory'}", err=True)
        return base | data | {"status": "failed", "error": str(error), "exit_code": 2}
    except (Interrupted, typer.Exit):
        return base | data | {"status": "interrupted", "error": "", "exit_code": 130}
    return base | data | {"status": "done", "error": "", "exit_code": 0}


def _show(results: list[dict[str, Any]]) -> None:
    from lgrasp_cli.tables import print_table

    columns = ("hand", "object", "pipeline", "grasps", "strict/s", "seed/s", "wall s", "near-dup", "poses", "status")
    print_table(columns, [_row(result) for result in results], right=columns[3:9])


def _row(result: dict[str, Any]) -> tuple[str, ...]:
    named = (Path(result["hand"]).stem, Path(result["object"]).stem, result["pipeline"])
    if "grasps" not in result:
        return (*named, *("-" for _ in range(6)), result["status"])
    return (
        *named,
        f"{result['grasps']:,}",
        f"{result['strict_valid_per_s']:,.0f}",
        f"{result['seed_count_per_s']:,.0f}",
        f"{result['seconds']['total']:.1f}",
        f"{result['near_duplicates']:,}",
        f"{result['distinct_poses']:,}",
        result["status"],
    )


def _show_plans(jobs: list[Any]) -> None:
    from lgrasp.jobs.preview import plan
    from lgrasp_cli.tables import print_table

    lines = {line: None for job in jobs for line in plan(job)}
    print_table(("what", "which", "state", "to do", "file"), lines)
