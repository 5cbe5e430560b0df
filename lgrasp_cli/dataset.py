"""``lgrasp dataset``: look at, check and merge grasp files."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lgrasp_cli.options import JsonPath, Quiet, check_report, old_name, warn
from lgrasp_cli.working import How, working

if TYPE_CHECKING:
    from rich.table import Table

app = typer.Typer(help="Inspect, check and merge grasp files (shards).", no_args_is_help=True)

_Paths = Annotated[list[Path], typer.Argument(help="Shard files, or folders of *.h5 files.", show_default=False)]


@app.command()
def info(
    paths: _Paths,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Show rows, hand, objects, pipeline, size and metrics of each shard; for sequences, rows by number of objects.

    Example: lgrasp dataset info out/mug
    """
    from lgrasp.dataset import describe

    shards = describe(paths)
    if as_json:
        typer.echo(json.dumps(shards, indent=2))
        return
    from rich.console import Console

    console = Console()
    console.print(_shard_table(shards))
    console.print(_metric_table(shards))
    if any(set(s["rows_by_objects"]) - {"1"} for s in shards):
        console.print(_count_table(shards, "objects in the hand", "rows_by_objects"))
    if any(s["rows_by_space"] for s in shards):
        console.print(_count_table(shards, "opposition space of the last step", "rows_by_space"))


@app.command()
def check(
    paths: _Paths,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON on standard output.")] = False,
) -> None:
    """Check every byte and value of each shard against the format; exit code 2 if one has a problem.

    Example: lgrasp dataset check out/mug
    """
    from lgrasp.dataset import find_shards, validate_shard

    problems = {str(path): validate_shard(path) for path in find_shards(paths)}
    if as_json:
        typer.echo(json.dumps(problems, indent=2))
    for path, lines in problems.items():
        for line in lines:
            typer.echo(f"{path}: {line}", err=True)
    bad = sum(map(bool, problems.values()))
    if bad:
        raise typer.Exit(2)
    if not as_json:
        typer.echo(f"{_counted(len(problems), 'shard')} valid")


app.command("validate", hidden=True)(old_name(check, "lgrasp dataset validate", "lgrasp dataset check"))


@app.command()
def merge(
    paths: _Paths,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write.", show_default=False)],
    manifest: Annotated[
        Path | None, typer.Option(help="List of shards to check against; by default manifest.json of a single folder.")
    ] = None,
) -> None:
    """Put the rows of shards of one hand, object and run into one file.

    Example: lgrasp dataset merge out/mug -o mug.h5
    """
    from lgrasp.dataset import merge_shards

    rows = merge_shards(paths[0] if len(paths) == 1 else paths, out, manifest=manifest)
    typer.echo(f"{out}: {rows} rows")


@app.command()
@working
def metrics(
    paths: _Paths,
    how: How,
    add: Annotated[str, typer.Option(help="Metrics, separated by commas: volume, epsilon_exact.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the new shards.", show_default=False)],
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="bounds.KEY=VALUE",
            help="Measure with another value than that of the rows, such as bounds.friction=0.8.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Copy shards and add quality metrics to the copies; existing copies are kept.

    Subfolders are searched and recreated in --out. docs/reference/metrics.md defines the metrics.

    Example: lgrasp dataset metrics grasps/allegro-mug --add volume,epsilon_exact -o grasps/measured
    """
    from lgrasp.jobs.metrics import MetricsJob

    names = tuple(name.strip() for name in add.split(","))
    job = how.job(MetricsJob, "dataset metrics", shards=paths, out=out, add=names, settings=settings)
    how.run(job, _show_metrics)


def _show_metrics(data: dict[str, Any]) -> None:
    there = f"; {data['present']:,} rows there already" if data["present"] else ""
    made = f"{_counted(len(data['shards']), 'shard')}, {data['rows']:,} rows, {data['rows_per_s']:,.0f} rows/s"
    typer.echo(f"{data['out']}: {made}{there}")


@app.command()
def report(
    paths: _Paths,
    out: Annotated[Path, typer.Option("--out", "-o", help="HTML file to write.")] = Path("report.html"),
    json_path: JsonPath = None,
    quiet: Quiet = False,
) -> None:
    """Write a report on a data set as one HTML page: validity, quality, diversity, coverage, physics.

    Shards may be of several hands and objects; subfolders are searched. The page works offline.

    Example: lgrasp dataset report grasps --out report.html --json report.json
    """
    check_report(json_path)
    from lgrasp.dataset.report import report_dataset
    from lgrasp.engine.report import check_json, write_json
    from lgrasp_cli.counting import counting
    from lgrasp_cli.tables import print_json, print_pairs

    check_json(out)
    with counting("read", quiet=quiet) as progress:
        numbers = report_dataset(paths, out, progress=progress)
    if json_path == "-":
        print_json(numbers)
    elif json_path:
        write_json(json_path, numbers)
    for line in numbers["remarks"]:
        warn(line)
    if not quiet and json_path != "-":
        print_pairs(_report_pairs(numbers, out))


def _report_pairs(numbers: dict[str, Any], out: Path) -> list[tuple[str, str]]:
    groups = [group for hand in numbers["hands"] for group in hand["objects"]]
    over = {}
    for group in groups:
        for name, metric in group["metrics"].items():
            over[name] = over.get(name, 0) + (metric["over_bound"] or 0)
    above = ", ".join(f"{name} {count:,}" for name, count in over.items() if count)
    near = sum(group["near_duplicates"]["duplicates"] for group in groups)
    pairs = [
        ("grasps", f"{numbers['rows']:,} in {_counted(numbers['shards'], 'shard')}, {numbers['bytes'] / 1e6:,.1f} MB"),
        ("hands", ", ".join(f"{h['hand']} ({_counted(len(h['objects']), 'object')})" for h in numbers["hands"])),
        ("above a strict bound", above or "none"),
        ("near-duplicates", f"{near:,}"),
        ("distinct poses", f"{sum(group['distinct_poses'] for group in groups):,}"),
    ]
    held: dict[str, int] = {}
    for hand in numbers["hands"]:
        for n, group in hand["held"].items():
            held[n] = held.get(n, 0) + group["rows"]
    if set(held) - {"1"}:
        pairs.append(("objects in the hand", ", ".join(f"{n}: {rows:,}" for n, rows in sorted(held.items()))))
    for name in sorted({name for group in groups for name in group["physics"]}):
        found = [group["physics"][name] for group in groups if name in group["physics"]]
        pairs.append((f"hold in {name}", f"{sum(f['held'] for f in found):,} of {sum(f['run'] for f in found):,}"))
    return [*pairs, ("where", str(out))]


def _counted(n: int, what: str) -> str:
    return f"{n:,} {what}{'' if n == 1 else 's'}"


def _shard_table(shards: list[dict[str, Any]]) -> "Table":
    from rich.table import Table

    table = Table("shard", "hand", "objects", "pipeline", "seed", "index")
    for name in ("rows", "joints", "MB"):
        table.add_column(name, justify="right")
    for s in shards:
        texts = (Path(s["file"]).name, s["hand"], ", ".join(s["objects"]), s["pipeline"], s["seed"], s["shard_index"])
        table.add_row(*map(str, texts), f"{s['rows']:,}", str(len(s["joints"])), f"{s['bytes'] / 1e6:.1f}")
    if len(shards) > 1:
        total, size = sum(s["rows"] for s in shards), sum(s["bytes"] for s in shards)
        table.add_section()
        table.add_row(f"{len(shards)} shards", "", "", "", "", "", f"{total:,}", "", f"{size / 1e6:.1f}")
    return table


def _metric_table(shards: list[dict[str, Any]]) -> "Table":
    from rich.table import Table

    table = Table("shard", "metric", "unit")
    for name in ("min", "mean", "max"):
        table.add_column(name, justify="right")
    for s in shards:
        for metric, values in s["metrics"].items():
            numbers = ("-" if values[k] is None else f"{values[k]:.4g}" for k in ("min", "mean", "max"))
            table.add_row(Path(s["file"]).name, metric, values["unit"], *numbers)
    return table


def _count_table(shards: list[dict[str, Any]], what: str, key: str) -> "Table":
    """Rows of all shards by the names under ``key``."""
    from rich.table import Table

    counts: dict[str, int] = {}
    for s in shards:
        for name, rows in (s[key] or {}).items():
            counts[name] = counts.get(name, 0) + rows
    table = Table(what)
    table.add_column("rows", justify="right")
    for name, rows in counts.items():
        table.add_row(name, f"{rows:,}")
    return table
