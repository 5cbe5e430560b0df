"""``lgrasp generate``: the main job."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lgrasp_cli.options import (
    CacheDir,
    Contacts,
    Device,
    Hand,
    JsonPath,
    Mesh,
    PipelineName,
    Quiet,
    Scale,
    Seed,
    Settings,
    check_report,
    choose_pipeline,
    open_cache,
)

if TYPE_CHECKING:
    from lgrasp.jobs.generate import Job, Outcome


def register(app: typer.Typer) -> None:
    """Mount the commands of this file."""
    app.command()(generate)


def generate(
    mesh: Mesh,
    hand: Hand = "allegro",
    rows: Annotated[int, typer.Option("-n", "--rows", help="Grasps asked.")] = 1000,
    pipeline: PipelineName = "robust",
    settings: Settings = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder of the shards; default: grasps/HAND-OBJECT", show_default=False),
    ] = None,
    seed: Seed = None,
    contacts: Contacts = None,
    scale: Scale = 1.0,
    device: Device = "auto",
    workers: Annotated[int, typer.Option(min=0, help="Threads; 0: all cores (1 on a GPU).")] = 0,
    batch: Annotated[int, typer.Option(min=0, help="Candidates per batch; 0: by device.")] = 0,
    physics: Annotated[
        str | None,
        typer.Option(
            help="Keep only grasps that pass this physics protocol: fc, gravity6 or gravity6_mu1.", show_default=False
        ),
    ] = None,
    shard_rows: Annotated[int, typer.Option(help="Rows of a shard; part of what decides the rows.")] = 10_000,
    reuse: Annotated[bool, typer.Option("--reuse", help="Keep the candidates in the cache for later runs.")] = False,
    resume: Annotated[bool, typer.Option("--resume/--no-resume", help="Keep whole shards of the same run.")] = True,
    shard_index: Annotated[
        int | None,
        typer.Option(
            help="Task of an array: makes every NUMth shard; default: SLURM_ARRAY_TASK_ID.", show_default=False
        ),
    ] = None,
    num_shards: Annotated[
        int | None,
        typer.Option(help="Tasks of the array; default: SLURM_ARRAY_TASK_COUNT.", show_default=False),
    ] = None,
    json_path: JsonPath = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what would be computed; change nothing.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Make hand, object, field and shards anew.")] = False,
    cache_dir: CacheDir = None,
    quiet: Quiet = False,
) -> None:
    """Generate grasps of an object and write them as shards.

    Exit code 3 when fewer grasps than asked were found; what was found is kept.

    Example: lgrasp generate --object mug.obj -n 10000
    """
    cache = open_cache(cache_dir, fresh=force)
    from lgrasp.jobs.config import array_task, default_out
    from lgrasp.jobs.generate import Job

    index, number = array_task(shard_index, num_shards)
    chosen = choose_pipeline(pipeline, seed, contacts, settings)
    job = Job(
        hand=hand,
        object=mesh,
        rows=rows,
        pipeline=chosen.with_physics(physics) if physics else chosen,
        out=out or default_out(hand, mesh, physics),
        scale=scale,
        device=device,
        workers=workers,
        batch=batch,
        shard_rows=shard_rows,
        shard_index=index,
        num_shards=number,
        reuse=reuse,
        resume=resume and not force,
        cache=cache,
    )
    if dry_run:
        _show_plan(job, json_path)
        return
    check_report(json_path)
    data, outcome = run_job(job, quiet=quiet)
    from lgrasp_cli.tables import job_report, print_pairs, print_report

    print_report(data, json_path, None if quiet else lambda: print_pairs(job_report(data)))
    conclude(data, outcome)


def run_job(job: "Job", *, quiet: bool) -> tuple[dict[str, Any], "Outcome"]:
    """Run a job with progress; its report and outcome."""
    from lgrasp.engine.report import report
    from lgrasp.jobs.generate import generate as run
    from lgrasp.jobs.generate import job_shards
    from lgrasp_cli.progress import JobProgress, interruptible

    with JobProgress(dict(job_shards(job)), quiet=quiet) as progress, interruptible(progress):
        outcome = run(job, progress)
    return report(job, outcome), outcome


def conclude(data: dict[str, Any], outcome: "Outcome") -> None:
    """Leave with the exit code of a job that fell short.

    Raises:
        StarvedError: fewer grasps than asked.
    """
    from lgrasp.errors import StarvedError
    from lgrasp.jobs.bottleneck import starving_stage

    if outcome.cancelled:
        typer.echo(
            f"interrupted: {len(outcome.paths)} whole shards in {data['out']}; the same command goes on", err=True
        )
        raise typer.Exit(130)
    if outcome.starved:
        stage, words = starving_stage(data["counts"])
        raise StarvedError(f"{data['grasps']:,} of {data['asked']:,} grasps found; stage {stage} starves: {words}")


def _show_plan(job: "Job", json_path: str | None) -> None:
    from lgrasp.jobs.preview import plan
    from lgrasp_cli.tables import print_json, print_table

    lines = plan(job)
    data = [line._asdict() for line in lines]
    if json_path == "-":
        print_json(data)
        return
    if json_path:
        from lgrasp.engine.report import write_json

        write_json(json_path, data)
    print_table(("what", "which", "state", "to do", "file"), lines)
