"""``lgrasp dataset`` and ``export``: look at, check, merge and convert grasp files."""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from typer import Argument, Option

from lgrasp.choices import FormatName, MetricName
from lgrasp.words import number, plural
from lgrasp_cli.names import one_of
from lgrasp_cli.options import Quiet, Shards, Where, old_name, set_option, split, warn
from lgrasp_cli.tables import Answer, Block, TextTable, checked, ending, reporting, took
from lgrasp_cli.training import normalisation, split_rows
from lgrasp_cli.working import How, working

app = typer.Typer(name="dataset", help="Inspect, check and merge grasp files (shards).", no_args_is_help=True)


@app.command()
@reporting
def info(paths: Shards) -> Answer:
    """Show rows, hand, objects, pipeline and size of shards, metrics of those alike, rows of sequences by object count.

    Example: lgrasp dataset info grasps
    """
    from lgrasp.dataset.info import describe

    shards = describe(paths)
    blocks = [_shard_table(shards), "", _metric_table(shards)]
    if any(set(s["rows_by_objects"]) - {"1"} for s in shards):
        blocks += ["", _count_table(shards, "objects in the hand", "rows_by_objects")]
    if any(s["rows_by_space"] for s in shards):
        blocks += ["", _count_table(shards, "opposition space of the last step", "rows_by_space")]
    return Answer(shards, blocks)


@app.command()
@reporting
def check(paths: Shards) -> Answer:
    """Check every byte and value of each shard against the format, and each folder against its manifest.json.

    Exit code 2 if a file has a problem, or one that is listed is missing.

    Example: lgrasp dataset check grasps
    """
    from lgrasp.dataset.differences import check_files
    from lgrasp.dataset.validate import validate_shard

    return checked(check_files(paths, validate_shard), "shard")


app.command("validate", hidden=True)(old_name(check, "lgrasp dataset validate", "lgrasp dataset check"))


@app.command()
def merge(
    paths: Annotated[list[Path], Argument(metavar="SHARDS", help="Shard files, or the folder of a run.")],
    out: Annotated[Path, Option("--out", "-o", help="File to write.")],
    manifest: Annotated[
        Path | None, Option(help="List of shards to check against; by default manifest.json of a single folder.")
    ] = None,
    partial: Annotated[bool, Option("--partial", help="Merge what is there, even if the list has more.")] = False,
) -> None:
    """Put the rows of shards of one hand, object and run into one file.

    Example: lgrasp dataset merge grasps/allegro-mug/robust -o mug.h5
    """
    from lgrasp.dataset.files import find_shards

    find_shards(paths)
    from lgrasp.dataset.merge import merge_shards

    rows = merge_shards(paths[0] if len(paths) == 1 else paths, out, manifest=manifest, partial=partial)
    typer.echo(f"{out}: {rows:,} rows")


app.command("split")(split_rows)
app.command()(normalisation)


@app.command()
@working
def metrics(
    paths: Shards,
    how: How,
    add: Annotated[str, Option(help=f"Metrics, separated by commas: {', '.join(get_args(MetricName))}.")],
    out: Annotated[Path, Option("--out", "-o", help="Folder of the new shards.")],
    settings: Annotated[
        list[str] | None, set_option(help="Measure with another value, such as bounds.friction=0.8 or hold.draws=16.")
    ] = None,
) -> None:
    """Copy shards and add quality metrics to the copies; existing copies are kept or extended.

    Metric hold tests how well grasps hold. Subfolders are searched and recreated in --out.
    docs/reference/metrics.md defines the metrics.

    Example: lgrasp dataset metrics grasps/allegro-mug/robust --add volume,epsilon_exact -o grasps/measured
    """
    from lgrasp.jobs.requests.shards import MetricsRequest

    what = {"shards": paths, "out": out, "add": split(add), "settings": settings}
    how.run(how.job(MetricsRequest, "dataset metrics", **what), _show_metrics)


def _show_metrics(data: dict[str, Any]) -> list[Block]:
    pairs = [
        ("rows", f"{data['rows']:,}; {data['present']:,} were there already"),
        ("metrics", ", ".join(data["metrics"])),
        *ending(data, "rows", "dataset report"),
    ]
    return [_set_table(data["sets"]), "", pairs] if data["sets"] else [pairs]


def _set_table(sets: list[dict[str, Any]]) -> TextTable:
    """What each set of grasps covers, and how different they are; docs/reference/metrics.md defines the columns."""
    columns = ("hand", "object", "rows", "approach", "surface", "PCA 1", "PCA 5", "entropy", "std")
    rows = []
    for found in sets:
        objects = " + ".join(found["objects"])
        for one, cover in found["coverage"].items():
            ratio, entropy = (found["diversity"][one][name] for name in ("pca_ratio", "joint_entropy"))
            cells = [f"{cover[name]['share']:.1%}" for name in ("directions", "surface")]
            cells += [f"{ratio[0]:.1%}", f"{ratio[-1]:.1%}"] if ratio else ["-", "-"]
            cells += [f"{entropy[name]:.2f}" if entropy else "-" for name in ("mean", "std")]
            of = objects if one == objects else f"{objects}: {one}"
            rows.append((found["hand"], of, f"{found['rows']:,}", *cells))
    return TextTable(columns, rows, right=columns[2:])


@app.command()
@reporting
def report(
    paths: Shards,
    out: Annotated[Path, Option("--out", "-o", help="HTML file to write.")] = Path("report.html"),
    quiet: Quiet = False,
) -> Answer:
    """Write a report on a data set as one HTML page: validity, quality, diversity, coverage, physics.

    Shards may be of several hands and objects; subfolders are searched. The page works offline.

    Example: lgrasp dataset report grasps --out report.html --json report.json
    """
    from lgrasp.outputs import check_file

    check_file(out)
    from lgrasp.dataset.report.write import report_dataset
    from lgrasp_cli.progress import Bar

    with Bar(quiet=quiet) as bar:
        numbers = report_dataset(paths, out, progress=lambda done, rows: bar.show("read", done, rows, "rows"))
    for line in numbers["remarks"]:
        warn(line)
    sets = [{"hand": hand["hand"], **group} for hand in numbers["hands"] for group in hand["objects"]]
    tables = [_set_table(sets), ""] if sets else []
    return Answer(numbers, [] if quiet else [*tables, _report_pairs(numbers, out)])


def _report_pairs(numbers: dict[str, Any], out: Path) -> list[tuple[str, str]]:
    groups = [group for hand in numbers["hands"] for group in hand["objects"]]
    over = _sums({name: metric["over_bound"] or 0 for name, metric in group["metrics"].items()} for group in groups)
    held = _sums({n: group["rows"] for n, group in hand["held"].items()} for hand in numbers["hands"])
    near = sum(group["near_duplicates"]["duplicates"] for group in groups)
    from lgrasp.dataset.report.verdicts import passed_words

    physics = []
    for name in sorted({name for group in groups for name in group["physics"]}):
        found = [group["physics"][name] for group in groups if name in group["physics"]]
        physics.append((passed_words(name), f"{sum(f['held'] for f in found):,} of {sum(f['run'] for f in found):,}"))
    pairs = [
        ("grasps", f"{numbers['rows']:,} in {plural(numbers['shards'], 'shard')}, {numbers['bytes'] / 1e6:,.1f} MB"),
        ("hands", ", ".join(f"{h['hand']} ({plural(len(h['objects']), 'object')})" for h in numbers["hands"])),
        *physics,
        ("above a strict bound", ", ".join(f"{name} {count:,}" for name, count in over.items() if count) or "none"),
        ("near-duplicates", f"{near:,}"),
        ("distinct poses", f"{sum(group['distinct_poses'] for group in groups):,}"),
    ]
    types = _sums(hand["grasp_types"] for hand in numbers["hands"])
    if types:
        pairs.append(("grasp types", ", ".join(f"{name or 'none asked'} {rows:,}" for name, rows in types.items())))
    if set(held) - {"1"}:
        pairs.append(("objects in the hand", ", ".join(f"{n}: {rows:,}" for n, rows in sorted(held.items()))))
    return [*pairs, ("where", str(out))]


def _sums(parts: Iterable[dict[str, int]]) -> Counter[str]:
    """The numbers of the parts by name, in the order in which the names come."""
    total: Counter[str] = Counter()
    for part in parts:
        total.update(part)
    return total


def _places(shards: list[dict[str, Any]]) -> list[str]:
    from lgrasp.dataset.files import places

    return places(Path(s["file"]) for s in shards)


def _shard_table(shards: list[dict[str, Any]]) -> TextTable:
    columns = ("shard", "hand", "objects", "pipeline", "seed", "index", "rows", "joints", "MB")
    rows = [
        (
            name,
            *map(str, (s["hand"], ", ".join(s["objects"]), _made_by(s), s["seed"], s["shard_index"])),
            f"{s['rows']:,}" + (f" ({s['invalid']:,} invalid)" if s["invalid"] else ""),
            str(len(s["joints"])),
            f"{s['bytes'] / 1e6:.1f}",
        )
        for name, s in zip(_places(shards), shards, strict=True)
    ]
    if len(shards) > 1:
        total, size = sum(s["rows"] for s in shards), sum(s["bytes"] for s in shards)
        rows.append((plural(len(shards), "shard"), "", "", "", "", "", f"{total:,}", "", f"{size / 1e6:.1f}"))
    return TextTable(columns, rows, right=columns[6:])


def _made_by(shard: dict[str, Any]) -> str:
    """The pipeline, with the grasp type if one was asked for."""
    return ", ".join(filter(None, (shard["pipeline"], shard["grasp_type"])))


def _metric_table(shards: list[dict[str, Any]]) -> TextTable:
    """Of shards of the same hand, objects and pipeline together."""
    from lgrasp.dataset.info import pooled

    alike: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for s in shards:
        alike.setdefault((s["hand"], ", ".join(s["objects"]), _made_by(s)), []).append(s)
    ends = ("min", "mean", "max")
    rows = [
        (*(("",) * 3 if line else key), name, unit.partition(":")[0], *(number(values[k], ".4g") for k in ends))
        for key, those in alike.items()
        for line, ((name, unit), values) in enumerate(pooled(those).items())
    ]
    return TextTable(("hand", "objects", "pipeline", "metric", "unit", *ends), rows, right=ends)


def _count_table(shards: list[dict[str, Any]], what: str, key: str) -> TextTable:
    """Rows of all shards by the names under ``key``."""
    counts = _sums(s[key] or {} for s in shards)
    return TextTable((what, "rows"), [(name, f"{rows:,}") for name, rows in counts.items()], right=("rows",))


@working
def export(
    shards: Shards,
    how: How,
    to: Annotated[str, Option(**one_of(FormatName, "FORMAT", "Format to write."))],
    out: Annotated[Path, Option("--out", "-o", help="Folder to write; it must be empty or not exist yet.")],
    limit: Annotated[int | None, Option(help="Export at most so many grasps.")] = None,
    where: Where = None,
    only_holding: Annotated[
        bool, Option("--only-holding", help="Only grasps that held in simulation; same as --where physics/fc_holds.")
    ] = False,
    split_file: Annotated[
        Path | None, Option("--split", help="File written by dataset split; each part gets its own files (webdataset).")
    ] = None,
    licence: Annotated[
        str, Option(metavar="SPDX", help="Add a card with this licence, provenance and checksums.")
    ] = "",
) -> None:
    """Write grasps in the format of another program, with the hand's URDF and all meshes.

    Example: lgrasp export grasps/allegro-mug/robust --to isaac-grasp --out mug-isaac --where "metrics/epsilon > 0.01"
    """
    from lgrasp.jobs.requests.shards import ExportRequest
    from lgrasp.simulate.protocol import HOLDS

    conditions = [*(where or ()), *([HOLDS] if only_holding else ())]
    what = {"shards": shards, "out": out, "to": to, "where": conditions, "limit": limit}
    what |= {"split": split_file, "licence": licence}
    how.run(how.job(ExportRequest, "export", **what), _show_export)


def _show_export(data: dict[str, Any]) -> list[Block]:
    of = plural(len(data["objects"]), "object")
    pairs = [("grasps", f"{data['grasps']:,} of {of}, {data['format']}"), *took(data, "grasps"), ("where", data["out"])]
    return [pairs]
