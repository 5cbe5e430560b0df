"""``lgrasp bench``: how fast, on this machine; ``lgrasp bench table1``: beside the published figures."""

from pathlib import Path
from typing import Annotated, Any

import typer

from lgrasp_cli.bench_refine import bench_refine
from lgrasp_cli.bench_sequence import bench_sequence
from lgrasp_cli.interrupt import before_end
from lgrasp_cli.options import Device, Hand, JsonPath, check_report, open_cache, warn
from lgrasp_cli.table1 import table1

app = typer.Typer(invoke_without_command=True, subcommand_metavar="[table1|sequence|refine [OPTIONS]]")
app.command()(table1)
app.command("sequence")(bench_sequence)
app.command("refine")(bench_refine)


@app.callback()
def bench(
    context: typer.Context,
    hand: Hand = "allegro",
    objects: Annotated[str, typer.Option(help="Names or mesh files, separated by commas.")] = "mug",
    pipelines: Annotated[str, typer.Option(help="Names or YAML files, separated by commas.")] = "swift,lightning",
    rows: Annotated[int, typer.Option("-n", "--rows", help="Grasps per run.")] = 2000,
    repeat: Annotated[int, typer.Option(min=1, help="Runs of each pipeline and object.")] = 3,
    object_dir: Annotated[
        Path | None, typer.Option(help="Folder where the names of objects are looked up first.", show_default=False)
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Base seed; default: the pipelines'.", show_default=False)] = None,
    device: Device = "auto",
    workers: Annotated[int, typer.Option(min=0, help="Threads; 0: all cores (1 on a GPU).")] = 0,
    json_path: JsonPath = None,
) -> None:
    """Measure pipelines side by side: grasps per second of placement through filter, and what lies beside it.

    Leaves no files behind, except compiled kernels in the cache.

    Example: lgrasp bench --objects mug,bowl --repeat 5
    """
    if context.invoked_subcommand:
        _refuse_options(context)
        return
    cache = open_cache(None)
    from lgrasp.bench.rate import Bench
    from lgrasp.config import parse_model
    from lgrasp.engine.pipeline import pipeline_files
    from lgrasp.jobs.config import JobConfig, plan_jobs
    from lgrasp_cli.tables import print_report

    names = [name.strip() for name in pipelines.split(",")]
    if "lightning" in names and "lightning" not in pipeline_files():
        warn("pipeline lightning is not installed; left out")
        names.remove("lightning")
    given = {
        "hands": [hand],
        "objects": [name.strip() for name in objects.split(",")],
        "object_dir": object_dir,
        "pipelines": names,
        "rows": rows,
        "seed": seed,
        "device": device,
        "workers": workers,
    }
    jobs = plan_jobs(parse_model(JobConfig, given, "bench"), cache)
    check_report(json_path)
    with Bench() as runs, before_end(runs.discard):
        results = runs.measure(jobs, repeat, lambda line: typer.echo(line, err=True))
    print_report(results, json_path, lambda: _show(results, rows, repeat))


def _refuse_options(context: typer.Context) -> None:
    """Options before the name of a subcommand would have no effect."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    if any(source is not None and source.name == "COMMANDLINE" for source in sources.values()):
        name = context.invoked_subcommand
        raise typer.BadParameter(f"options of 'bench {name}' come after its name: lgrasp bench {name} --device cpu")


def _show(results: list[dict[str, Any]], rows: int, repeat: int) -> None:
    from lgrasp_cli.tables import print_table

    first = results[0]
    typer.echo(f"{first['hand']} on {first['device']}: {rows:,} grasps, median of {repeat} (lowest to highest)")
    columns = ("object", "pipeline", "strict/s", "range", "seed/s", "grasps", "near-dup", "poses", "survivors")
    print_table(columns, [_speed(result) for result in results], right=("strict/s", "range", "seed/s", *columns[5:8]))
    typer.echo()
    stages = sorted({stage for result in results for stage in result["counts"]})
    columns = ("object", "pipeline", *stages, "wall s", "object s", "field s", "load s", "MB")
    print_table(columns, [_times(result, stages) for result in results], right=columns[2:])
    typer.echo("thread-seconds per stage; object, field: made from nothing; load: both from the cache")


def _speed(result: dict[str, Any]) -> tuple[str, ...]:
    strict = result["strict_valid_per_s"]
    return (
        result["object"],
        result["pipeline"],
        f"{strict['median']:,.0f}",
        f"{strict['min']:,.0f}-{strict['max']:,.0f}",
        f"{result['seed_count_per_s']['median']:,.0f}",
        f"{result['grasps']:,}" + (" starved" if result["starved"] else ""),
        f"{result['near_duplicates']:,}",
        f"{result['distinct_poses']:,}",
        "  ".join(f"{stage} {count:,}" for stage, count in result["survivors"].items()),
    )


def _times(result: dict[str, Any], stages: list[str]) -> tuple[str, ...]:
    seconds, built = result["seconds"], result["build_seconds"]
    return (
        result["object"],
        result["pipeline"],
        *(f"{seconds.get(stage, 0.0):.2f}" for stage in stages),
        f"{seconds['wall']:.2f}",
        f"{built['object']:.2f}",
        f"{built['field']:.2f}",
        f"{sum(result['load_seconds'].values()):.2f}",
        f"{result['peak_rss_mb']:,.0f}",
    )
