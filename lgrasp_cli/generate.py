"""``lgrasp generate``: the main job."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from lgrasp_cli.options import Contacts, DryRun, Hand, Mesh, PipelineName, Scale, Seed, Settings, choose_pipeline
from lgrasp_cli.tables import Block, TextTable, counted, place, print_report
from lgrasp_cli.working import How, working

if TYPE_CHECKING:
    from lgrasp.engine.run import Job


@working
def generate(
    mesh: Mesh,
    how: How,
    hand: Hand = "allegro",
    rows: Annotated[int, Option("-n", "--rows", help="Grasps requested.")] = 1000,
    pipeline: PipelineName = "robust",
    settings: Settings = None,
    out: Annotated[Path | None, Option(help="Folder of the shards; default: grasps/HAND-OBJECT")] = None,
    seed: Seed = None,
    contacts: Contacts = None,
    scale: Scale = 1.0,
    batch: Annotated[int, Option(min=0, help="Candidates per batch; 0: by device.")] = 0,
    simulate: Annotated[
        str | None, Option(help="Keep only grasps that hold in simulation, with protocol fc, gravity6 or gravity6_mu1.")
    ] = None,
    shard_rows: Annotated[
        int, Option(help="Grasps per shard. Changing it changes which grasps are generated.")
    ] = 10_000,
    passes: Annotated[
        int | None,
        Option(
            min=1,
            max=64,
            help="Searches per successful pose: faster, but fewer poses; default: the pipeline's, or 8 with --reuse.",
        ),
    ] = None,
    reuse: Annotated[
        bool,
        Option("--reuse", help="Cache the state of shards, so that a later run with a larger -n continues from there."),
    ] = False,
    dry_run: DryRun = False,
) -> None:
    """Generate grasps of an object and write them as shards.

    The exit code is 3 if fewer grasps are found than requested; those found are kept.

    Example: lgrasp generate --object mug.obj -n 10000
    """
    from lgrasp.engine.bank import with_passes
    from lgrasp.jobs.config import default_out
    from lgrasp.jobs.generate import GenerateJob

    chosen = with_passes(choose_pipeline(pipeline, seed, contacts, settings), passes, reuse)
    chosen = chosen.with_simulation(simulate) if simulate else chosen
    out = out or default_out(hand, mesh, simulate)
    what = {"hand": hand, "object": mesh, "rows": rows, "pipeline": chosen, "out": out, "scale": scale}
    job = how.job(GenerateJob, "generate", **what, batch=batch, shard_rows=shard_rows, reuse=reuse)
    if dry_run:
        show_plans([(job, how)], how)
    else:
        how.run(job, _show)


def show_plans(jobs: "list[tuple[Job, How]]", how: How) -> None:
    """Print the plans of jobs, each with its own array task."""
    from lgrasp.jobs.preview import preview

    lines = list({x: None for job, own in jobs for x in preview(job, array=own.array, resume=not own.overwrite)})
    table = TextTable(("what", "which", "state", "to do", "file"), lines)
    print_report([line._asdict() for line in lines], how.json_path, [table])


def _show(data: dict[str, Any]) -> list[Block]:
    seconds, stages = data["seconds"], list(data["counts"])
    rates = []
    if data["made"]:
        rates.append(("strict-valid", f"{data['strict_valid_per_s']:,.0f} /s ({data['strict']:,})"))
        if data["strict"] < data["grasps"]:
            rates.append(("by own bounds", f"{data['grasps_per_s']:,.0f} /s ({data['grasps']:,})"))
        rates.append(("published count", f"{data['published_count_per_s']:,.0f} /s ({data['published_count']:,})"))
    device_memory = f", device {data['peak_device_mb']:,.0f} MB" if data["peak_device_mb"] else ""
    pairs = [
        ("grasps", counted(data, "grasps")),
        place(data),
        ("hand, object", f"{data['hand']}, {data['object']}; pipeline {data['pipeline']}, seed {data['seed']}"),
        ("wall", f"{seconds['total']:.2f} s, {seconds['wall']:.2f} s of it from placement through filter"),
        *rates,
        ("survivors", "  ".join(f"{name} {data['survivors'][name]:,}" for name in stages)),
        ("thread-seconds", "  ".join(f"{name} {seconds[name]:.2f}" for name in stages)),
        ("loading", "  ".join(f"{n} {seconds[n]:.2f} s" for n in ("hand", "object", "field", "kernels"))),
        ("near-duplicates", f"{data['near_duplicates']:,}"),
        ("distinct poses", f"{data['distinct_poses']:,}"),
        ("peak memory", f"{data['peak_rss_mb']:,.0f} MB{device_memory}"),
        ("device", data["device"]),
    ]
    return [pairs]
