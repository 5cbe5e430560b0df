"""``lgrasp bench sequence``: the published tables of sequential grasps, ours beside them."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from lgrasp_cli.options import CacheDir, Device, Hand, JsonPath, check_report, open_cache

if TYPE_CHECKING:
    pass


def bench_sequence(
    objects: Annotated[
        list[str] | None,
        typer.Argument(help="Pool of objects: mesh files or names.", show_default="mug sphere box capsule bottle bowl"),
    ] = None,
    hand: Hand = "allegro",
    length: Annotated[int, typer.Option(min=2, help="Objects in a sequence.")] = 4,
    sequences: Annotated[int, typer.Option(min=1, help="Sequences of objects, drawn from the pool.")] = 3,
    width: Annotated[int, typer.Option("-n", "--width", min=1, help="Grasps begun with each sequence.")] = 256,
    methods: Annotated[str, typer.Option(help="Methods, separated by commas.")] = "field,anneal",
    baseline_width: Annotated[
        int, typer.Option("--baseline-n", min=1, help="Grasps begun by methods after the first.")
    ] = 32,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Of the optimiser; default: as published.", show_default="6000")
    ] = None,
    policy: Annotated[str, typer.Option(help="uniform, as published, or lookahead.")] = "uniform",
    physics: Annotated[str, typer.Option(help="Protocol: seq6 (friction 2.0, as published) or seq6_mu06.")] = "seq6",
    scale: Annotated[str, typer.Option(help="Factor to metres, or range of the longest side [m].")] = "0.06:0.10",
    pipeline: Annotated[
        str, typer.Option("--pipeline", "-p", help="Name of a pipeline with stage sequence, or a YAML file.")
    ] = "sequence",
    seed: Annotated[int, typer.Option(min=0, help="Draws the sequences and the grasps.")] = 0,
    device: Device = "auto",
    workers: Annotated[int, typer.Option(min=0, help="Threads; 0: all cores.")] = 0,
    json_path: JsonPath = None,
    cache_dir: CacheDir = None,
) -> None:
    """Measure success by opposition space and by number of objects, the field search beside the published optimiser.

    Every row is simulated, and only rows that hold are gone on from. Nothing is written but the cache.

    Example: lgrasp bench sequence --sequences 2 --methods field
    """
    check_report(json_path)
    cache = open_cache(cache_dir)
    from pathlib import Path

    from lgrasp.bench.sequence import PUBLISHED, measure_sequences
    from lgrasp.config import parse_model
    from lgrasp.jobs.sequence.job import SequenceJob
    from lgrasp.jobs.sequence.sets import SequenceSets, object_sequences
    from lgrasp.jobs.sequence.size import parse_size
    from lgrasp_cli.options import choose_pipeline
    from lgrasp_cli.tables import print_report

    pool = objects or ["mug", "sphere", "box", "capsule", "bottle", "bowl"]
    sets = parse_model(SequenceSets, {"sets": sequences, "length": length, "permutations": 1}, "bench sequence")
    drawn = object_sequences(pool, sets, seed)
    results: dict[str, Any] = {"published": PUBLISHED, "sequences": drawn, "physics": physics, "methods": {}}
    for place, method in enumerate(name.strip() for name in methods.split(",")):
        chosen = choose_pipeline(pipeline, seed)
        changes: dict[str, Any] = {"method": method, "policy": policy, "width": baseline_width if place else width}
        if iterations:
            changes["optimiser"] = chosen.params("sequence").optimiser.model_dump() | {"iterations": iterations}
        jobs = [
            SequenceJob(
                hand=hand,
                objects=names,
                rows=1,
                pipeline=chosen.with_params("sequence", **changes),
                out=Path("."),
                size=parse_size(scale),
                physics=physics,
                device=device,
                workers=workers,
                cache=cache,
            )
            for names in drawn
        ]
        results["methods"][method] = measure_sequences(jobs, 1, lambda line: typer.echo(line, err=True))
        results["methods"][method]["width"] = changes["width"]
    print_report(results, json_path, lambda: _show(results))


def _show(results: dict[str, Any]) -> None:
    from lgrasp_cli.tables import print_table

    published = results["published"]
    for method, found in results["methods"].items():
        typer.echo(f"{method}: {found['width']} begun with each of {len(results['sequences'])} sequences")
        rows = [
            (
                name,
                f"{counts['tried']:,}",
                f"{counts['found']:,}",
                f"{counts['held']:,}",
                _share(counts["held"], counts["found"]),
                _share(counts["held"], counts["tried"]),
                f"{published['spaces'][name]:.1f} %" if name in published["spaces"] else "-",
            )
            for name, counts in found["spaces"].items()
        ]
        columns = ("space", "tried", "found", "hold", "hold/found", "hold/tried", "published")
        print_table(columns, rows, right=columns[1:])
        columns = (
            "objects",
            "simulated",
            "strict",
            "hold",
            "cumulative",
            "consumed",
            "penetration mm",
            "s per 256",
            "diversity",
        )
        print_table(columns, _by_number(found["objects"], published), right=columns[1:])
        typer.echo(f"strict-valid rows of two objects per second: {found['strict_per_s']:,.2f}\n")
    typer.echo(f"physics {results['physics']}; hold is conditional on the row before; penetration: median of the rows")
    typer.echo(f"(published): {published['source']}")


def _by_number(entries: list[dict[str, Any]], published: dict[str, Any]) -> list[tuple[str, ...]]:
    rows, cumulative = [], 1.0
    for number, entry in enumerate(entries, 1):

        def beside(ours: float | None, name: str, form: str, unit: str = "", number: int = number) -> str:
            theirs = published[name][number - 1] if number <= len(published[name]) else None
            return f"{_number(ours, form, unit)} ({_number(theirs, form, unit)})"

        cumulative *= (entry["success"] or 0.0) / 100
        rows.append(
            (
                str(number),
                f"{entry['simulated']:,}",
                f"{entry['strict']:,}",
                beside(entry["success"], "success", ".1f", " %"),
                f"{100 * cumulative:.1f} %",
                beside(entry["consumed"], "consumed", ".1f", " %"),
                beside(entry["penetration_median"], "penetration", ".2f"),
                beside(entry["seconds_per_256"], "seconds_per_256", ".1f"),
                beside(entry["diversity"], "diversity", ".3f"),
            )
        )
    return rows


def _share(part: int, whole: int) -> str:
    return f"{part / whole:.1%}" if whole else "-"


def _number(value: float | None, form: str, unit: str = "") -> str:
    return "-" if value is None else f"{value:{form}}{unit}"
