"""``lgrasp sequence``: several objects in one hand, one after another."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lgrasp_cli.options import (
    CacheDir,
    Device,
    Hand,
    JsonPath,
    Quiet,
    Seed,
    Settings,
    check_report,
    choose_pipeline,
    open_cache,
)

if TYPE_CHECKING:
    from lgrasp.jobs.sequence.job import SequenceJob, SequenceOutcome


def register(app: typer.Typer) -> None:
    """Mount the commands of this file."""
    app.command()(sequence)


def sequence(
    objects: Annotated[
        list[str], typer.Argument(help="Mesh files or names of objects, in the order of grasping.", show_default=False)
    ],
    hand: Hand = "allegro",
    rows: Annotated[int, typer.Option("-n", "--rows", help="Sequences asked: grasps of all the objects.")] = 256,
    method: Annotated[
        str | None, typer.Option(help="field, anneal or mala; default: the pipeline's.", show_default=False)
    ] = None,
    policy: Annotated[
        str | None, typer.Option(help="uniform or lookahead; default: the pipeline's.", show_default=False)
    ] = None,
    scale: Annotated[
        str, typer.Option(help="Factor to metres, or range of the longest side in metres such as 0.06:0.10.")
    ] = "1",
    physics: Annotated[
        str | None,
        typer.Option(
            help="Go on only with rows that pass this physics protocol: seq6 or seq6_mu06.", show_default=False
        ),
    ] = None,
    pipeline: Annotated[
        str, typer.Option("--pipeline", "-p", help="Name of a pipeline with stage sequence, or a YAML file.")
    ] = "sequence",
    settings: Settings = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder of the shards; default: grasps/HAND-OBJECT-OBJECT...", show_default=False),
    ] = None,
    seed: Seed = None,
    device: Device = "auto",
    workers: Annotated[int, typer.Option(min=0, help="Threads; 0: all cores (1 on a GPU).")] = 0,
    shard_rows: Annotated[int, typer.Option(help="Sequences of a shard; part of what decides the rows.")] = 1000,
    resume: Annotated[bool, typer.Option("--resume/--no-resume", help="Keep whole shards of the same run.")] = True,
    shard_index: Annotated[
        int | None, typer.Option(help="Task of an array; default: SLURM_ARRAY_TASK_ID.", show_default=False)
    ] = None,
    num_shards: Annotated[
        int | None, typer.Option(help="Tasks of the array; default: SLURM_ARRAY_TASK_COUNT.", show_default=False)
    ] = None,
    json_path: JsonPath = None,
    force: Annotated[bool, typer.Option("--force", help="Make hand, objects, fields and shards anew.")] = False,
    cache_dir: CacheDir = None,
    quiet: Quiet = False,
) -> None:
    """Grasp several objects one after another, each with joints that hold nothing yet, and write shards.

    Each grasp uses one opposition space of the hand (hand.yaml); joints and objects of earlier grasps stay in place.
    The shards hold the whole sequences and the rows of fewer objects that these go on from. Exit code 3 when fewer
    than asked were found; what was found is kept.

    Example: lgrasp sequence mug sphere -n 256 --scale 0.06:0.10
    """
    cache = open_cache(cache_dir, fresh=force)
    from lgrasp.jobs.config import array_task
    from lgrasp.jobs.hands import hand_source
    from lgrasp.jobs.sequence.job import SequenceJob, sequence_name
    from lgrasp.jobs.sequence.size import parse_size

    chosen = choose_pipeline(pipeline, seed, settings=settings)
    if "sequence" in chosen.order and (method or policy):
        changes = {"method": method, "policy": policy}
        chosen = chosen.with_params("sequence", **{name: value for name, value in changes.items() if value})
    index, number = array_task(shard_index, num_shards)
    job = SequenceJob(
        hand=hand,
        objects=tuple(objects),
        rows=rows,
        pipeline=chosen,
        out=out or Path("grasps") / sequence_name(hand_source(hand).name, tuple(objects)),
        size=parse_size(scale),
        physics=physics,
        device=device,
        workers=workers,
        shard_rows=shard_rows,
        shard_index=index,
        num_shards=number,
        resume=resume and not force,
        cache=cache,
    )
    check_report(json_path)
    data, outcome = run_sequences(job, quiet=quiet)
    from lgrasp_cli.tables import print_report

    print_report(data, json_path, None if quiet or not data["sequences"] else lambda: _show(data))
    conclude(data, outcome)


def run_sequences(job: "SequenceJob", *, quiet: bool) -> tuple[dict[str, Any], "SequenceOutcome"]:
    """Run a job with progress; its report and outcome."""
    from lgrasp.jobs.sequence.job import generate_sequences, sequence_shards
    from lgrasp.jobs.sequence.report import report
    from lgrasp_cli.progress import JobProgress, interruptible

    with JobProgress(dict(sequence_shards(job)), quiet=quiet) as progress, interruptible(progress):
        outcome = generate_sequences(job, progress)
    return report(job, outcome), outcome


def conclude(data: dict[str, Any], outcome: "SequenceOutcome") -> None:
    """Leave with the exit code of a job that fell short.

    Raises:
        ObjectError: no opposition space could hold an object.
        StarvedError: fewer sequences than asked.
    """
    from lgrasp.errors import ObjectError, StarvedError
    from lgrasp.jobs.sequence.report import unheld

    if outcome.cancelled:
        typer.echo(
            f"interrupted: {len(outcome.paths)} whole shards in {data['out']}; the same command goes on", err=True
        )
        raise typer.Exit(130)
    if outcome.starved:
        if not data["sequences"]:
            raise ObjectError(unheld(outcome))
        reached = ", ".join(f"{count:,} of {n}" for n, count in enumerate(data["reached"], 1))
        raise StarvedError(
            f"{data['sequences']:,} of {data['asked']:,} sequences found; rows reached, by number of objects: {reached}"
        )


def _show(data: dict[str, Any]) -> None:
    from lgrasp_cli.tables import print_pairs, print_table

    extra = f" ({data['present']:,} were there)" if data["present"] else ""
    print_pairs(
        [
            ("sequences", f"{data['sequences']:,} of {data['asked']:,} asked{extra}"),
            ("where", f"{data['out']} ({len(data['shards'])} shard{'s' if len(data['shards']) != 1 else ''})"),
            ("hand, objects", f"{data['hand']}; {', '.join(data['objects'])}"),
            ("how", f"pipeline {data['pipeline']}, method {data['method']}, policy {data['policy']}"),
            ("wall", f"{data['seconds']['total']:.2f} s, {data['seconds']['wall']:.2f} s of it the sequences"),
            ("penetration", f"median {data['penetration'][0]:.2f} mm, largest {data['penetration'][1]:.2f} mm"),
            ("device", data["device"]),
        ]
    )
    if data["spaces"]:
        print_table(
            ("object", "space", "sequences", "go on", "share"), _shares(data), right=("sequences", "go on", "share")
        )


def _shares(data: dict[str, Any]) -> list[tuple[str, ...]]:
    """How many sequences of each space went on, step by step."""
    rows = []
    for name, spaces in zip(data["objects"], data["spaces"], strict=False):
        for space, counts in spaces.items():
            tried, held = counts["sequence"]["sequences"], counts["sequence"]["held"]
            rows.append((name, space, f"{tried:,}", f"{held:,}", f"{held / tried:.1%}" if tried else "-"))
    return rows
