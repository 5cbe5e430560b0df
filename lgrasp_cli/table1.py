"""``lgrasp bench table1``: four hands, eight objects, our pipelines and the published figures side by side."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lgrasp_cli.interrupt import before_end
from lgrasp_cli.options import Device, JsonPath, check_report, open_cache, warn

if TYPE_CHECKING:
    from lgrasp.jobs.config import JobConfig

_List = Annotated[str | None, typer.Option(help="Names or files, separated by commas.", show_default="the published")]


def table1(
    hands: _List = None,
    objects: _List = None,
    hand_dir: Annotated[
        Path | None, typer.Option(help="Folder where NAME/NAME.urdf is looked up first.", show_default=False)
    ] = None,
    object_dir: Annotated[
        Path | None, typer.Option(help="Folder where the names of objects are looked up first.", show_default=False)
    ] = None,
    pipelines: Annotated[
        str | None,
        typer.Option(help="Names or files; those after the first are baselines.", show_default="swift,lightning"),
    ] = None,
    rows: Annotated[
        int | None, typer.Option("-n", "--rows", min=1, help="Grasps per run.", show_default="2000")
    ] = None,
    baseline_rows: Annotated[
        int | None,
        typer.Option("--baseline-n", min=1, help="Grasps per run of a baseline.", show_default="a tenth of -n"),
    ] = None,
    repeat: Annotated[int, typer.Option(min=1, help="Runs of each cell.")] = 3,
    shard_rows: Annotated[
        int | None, typer.Option(min=1, help="Rows of a shard; large ones fill a GPU.", show_default="10000")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Base seed; default: the pipelines'.", show_default=False)] = None,
    device: Device = "auto",
    workers: Annotated[int, typer.Option(min=0, help="Threads; 0: all cores (1 on a GPU).")] = 0,
    json_path: JsonPath = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Also draw the table as bars.", show_default=False)
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Keep the cells that --json PATH holds.")] = False,
) -> None:
    """Measure the published table: four hands, eight objects, swift and lightning in turn, beside the A100's figures.

    A cell is a hand with an object; --json PATH is written after each, so that an interrupted run keeps what it has.
    Hands and objects are those of configs/table1.yaml; without --hand-dir they have primitive geometry.

    Example: lgrasp bench table1 --hand-dir hands --object-dir meshes --json table1.json --plot table1.png
    """
    cache = open_cache(None)
    from lgrasp.bench.charts import check_plot, draw_table
    from lgrasp.bench.rate import Bench
    from lgrasp.bench.table1 import measure_table, new_table, read_table
    from lgrasp.config import parse_model
    from lgrasp.engine.report import write_json
    from lgrasp.errors import ConfigError
    from lgrasp.jobs.config import JobConfig, load_config
    from lgrasp_cli.tables import print_json

    changes = {
        "hands": hands and _split(hands),
        "objects": objects and _split(objects),
        "hand_dir": hand_dir,
        "object_dir": object_dir,
        "pipelines": pipelines and _split(pipelines),
        "rows": rows,
        "shard_rows": shard_rows,
        "seed": seed,
        "device": device,
        "workers": workers,
    }
    given = {name: value for name, value in changes.items() if value is not None}
    config = parse_model(JobConfig, load_config("table1").model_dump() | given, "bench table1")
    to_file = json_path is not None and json_path != "-"
    if resume and not to_file:
        raise ConfigError("--resume needs the file to go on with: --json PATH")
    check_report(json_path)
    if plot:
        check_plot(plot)
    if not objects:
        config = _those_here(config)
    table = new_table(config, repeat=repeat, baseline_rows=baseline_rows or max(1, config.rows // 10))
    if resume and json_path:
        table = read_table(Path(json_path), table)
    with Bench() as bench, before_end(bench.discard):
        measured = measure_table(bench, table, config, cache, progress=lambda line: typer.echo(line, err=True))
        for table, cell in measured:
            if to_file and json_path:
                write_json(json_path, table)
            typer.echo(_cell_line(table, cell), err=True)
    if plot:
        draw_table(table, plot)
    if json_path == "-":
        print_json(table)
    else:
        _show(table)
    _fail_if_nothing(table)


def _split(names: str) -> list[str]:
    return [name.strip() for name in names.split(",")]


def _those_here(config: "JobConfig") -> "JobConfig":
    """The config without the objects that are not here, which is said."""
    from lgrasp.bench.table1 import without_missing

    config, missing = without_missing(config)
    if missing:
        warn(f"left out {', '.join(missing)}: not shipped with lgrasp; --object-dir names a folder that has them")
    return config


def _cell_line(table: dict[str, Any], cell: dict[str, Any]) -> str:
    """What the newest cell gave, in one line."""
    total = len(table["hands"]) * len(table["objects"])
    rates = ", ".join(f"{name} {_rate(run)}/s" for name, run in cell["pipelines"].items())
    return f"[{len(table['cells'])}/{total}] {cell['hand']} {cell['object']}: {cell['error'] or rates}"


def _fail_if_nothing(table: dict[str, Any]) -> None:
    """The exit code of bad input if no cell could be measured."""
    from lgrasp.errors import ConfigError

    errors = [cell["error"] for cell in table["cells"]]
    if all(errors):
        raise ConfigError(f"no cell could be measured: {errors[0]}")


def _show(table: dict[str, Any]) -> None:
    settings, published = table["settings"], table["published"]
    baselines = [f", {name} {settings['baseline_rows']:,}" for name in settings["pipelines"][1:]]
    counts = f"{settings['rows']:,} grasps" + "".join(baselines)
    typer.echo(f"{settings['device']}: {counts}; strict-valid grasps per second, median of {settings['repeat']}")
    if published:
        typer.echo(f"published: {published['source']}, on {published['device']}")
    for hand in table["hands"]:
        _show_hand(table, hand)
    typer.echo("\ntrimmed mean: without the highest and the lowest object")
    typer.echo("object s, field s: made from nothing, not part of the rates; survivors and wall s: of the middle run")
    for cell in table["cells"]:
        if cell["error"]:
            typer.echo(f"{cell['hand']} {cell['object']} could not be measured: {cell['error']}")


def _show_hand(table: dict[str, Any], hand: str) -> None:
    from lgrasp_cli.tables import print_table

    names = table["settings"]["pipelines"]
    cells = [cell for cell in table["cells"] if cell["hand"] == hand and not cell["error"]]
    if not cells:
        return
    source = cells[0]["hand_from"]
    typer.echo(f"\n{hand}" + (f" ({source})" if source != hand else ""))
    columns = ("object", *(f"{n}/s" for n in names), *(f"{names[0]}/{n}" for n in names[1:]), "published/s")
    columns = (*columns, f"{names[0]}/published")
    rows = [_rates(cell["object"], [_rate(cell["pipelines"][n]) for n in names], cell) for cell in cells]
    mean = next(mean for mean in table["means"] if mean["hand"] == hand)
    rows.append(_rates("trimmed mean", [f"{mean['strict_valid_per_s'][n]:,.0f}" for n in names], mean))
    print_table(columns, rows, right=columns[1:])
    typer.echo()
    columns = ("object", "pipeline", "grasps", "range", "seed/s", "near-dup", "poses", "wall s", "object s", "field s")
    details = [_details(cell["object"], name, cell["pipelines"][name]) for cell in cells for name in names]
    print_table((*columns, "survivors"), details, right=columns[2:])


def _rates(what: str, rates: list[str], of: dict[str, Any]) -> list[str]:
    """A row: rates, ratios to the baselines, the published figure and the first pipeline's ratio to it."""
    ours = next(iter(of["published_ratio"].values()))
    figure = of["published_per_s"]
    ratios = [_times(ratio) for ratio in of["ratio"].values()]
    return [what, *rates, *ratios, "-" if figure is None else f"{figure:,.0f}", _times(ours)]


def _times(ratio: float | None) -> str:
    return "-" if ratio is None else f"{ratio:,.1f}" if ratio < 100 else f"{ratio:,.0f}"


def _rate(run: dict[str, Any]) -> str:
    return f"{run['strict_valid_per_s']['median']:,.0f}"


def _details(mesh: str, name: str, run: dict[str, Any]) -> list[str]:
    strict = run["strict_valid_per_s"]
    return [
        mesh,
        name,
        f"{run['grasps']:,}" + (" starved" if run["starved"] else ""),
        f"{strict['min']:,.0f}-{strict['max']:,.0f}",
        f"{run['seed_count_per_s']['median']:,.0f}",
        f"{run['near_duplicates']:,}",
        f"{run['distinct_poses']:,}",
        f"{run['seconds']['wall']:.2f}",
        f"{run['build_seconds']['object']:.2f}",
        f"{run['build_seconds']['field']:.2f}",
        "  ".join(f"{stage} {count:,}" for stage, count in run["survivors"].items()),
    ]
