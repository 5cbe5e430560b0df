"""``lgrasp refine``: grasps moved by a local search, checked again, and written again."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lgrasp_cli.options import CacheDir, Device, JsonPath, Quiet, check_report, open_cache, warn

if TYPE_CHECKING:
    from lgrasp.jobs.refine.shards import RefinedShard

_INTERVAL = 5.0  # [s] between lines of progress


def register(app: typer.Typer) -> None:
    """Mount the commands of this file."""
    app.command()(refine)


def refine(
    shards: Annotated[
        list[Path], typer.Argument(help="Shard files, or folders of them; or one export.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder of the refined shards.", show_default=False)],
    form: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="The grasps are in this format: dexgraspnet, dexgraspbench, isaac-grasp or mjcf.",
            show_default=False,
        ),
    ] = None,
    hand: Annotated[
        str | None,
        typer.Option(help="Hand of grasps in another format; shards hold their own.", show_default=False),
    ] = None,
    matching_rounds: Annotated[
        int | None, typer.Option(help="Times that nearest points are matched.", show_default=False)
    ] = None,
    gradient_steps: Annotated[
        int | None, typer.Option(help="Gradient steps after each matching.", show_default=False)
    ] = None,
    outer: Annotated[int | None, typer.Option(hidden=True)] = None,
    inner: Annotated[int | None, typer.Option(hidden=True)] = None,
    coarse: Annotated[
        bool, typer.Option("--coarse", help="Large steps and a long reach: for poses that are far off.")
    ] = False,
    always: Annotated[
        bool, typer.Option("--always", help="Store the refined posture of every row, valid or not.")
    ] = False,
    device: Device = "auto",
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there.")] = False,
    json_path: JsonPath = None,
    cache_dir: CacheDir = None,
    quiet: Quiet = False,
) -> None:
    """Move grasps by the gradient of the surface matching energy, check them again, and write shards.

    A refined posture takes the place of its row where it passes every check of the filter stage and resists pulls
    better; metrics 'refined', 'valid' and 'energy' say what became of a row.

    Example: lgrasp refine grasps/allegro-mug --out grasps/allegro-mug-refined
    """
    check_report(json_path)
    cache = open_cache(cache_dir)
    from lgrasp.jobs.refine.settings import refine_params
    from lgrasp.jobs.refine.shards import Refinement, refine_shards

    job = Refinement(
        sources=shards,
        out=out,
        form=form,
        hand=hand,
        always=always,
        params=refine_params(
            matching_rounds=matching_rounds, gradient_steps=gradient_steps, outer=outer, inner=inner, coarse=coarse
        ),
        device=device,
        force=force,
        cache=cache,
    )
    done = refine_shards(job, None if quiet else _Progress())
    clamped, far = sum(one.moved.clamped for one in done), sum(one.moved.far for one in done)
    if clamped:
        warn(f"joints of {clamped:,} rows were outside their limits and were clamped before the search")
    if far:
        warn(f"the hands of {far:,} rows are more than half a metre from their object; nothing draws them to it")
    data = [_report(one) for one in done]
    from lgrasp_cli.tables import print_report

    print_report(data, json_path, None if quiet else lambda: _show(data))


def _report(one: "RefinedShard") -> dict[str, Any]:
    rows = one.moved.rows
    return {
        "shard": str(one.path),
        "hand": one.hand,
        "object": one.object,
        "rows": len(rows),
        "refined": int(rows.metrics["refined"].sum()),
        "valid_before": one.moved.valid[0],
        "valid": one.moved.valid[1],
        "energy_before": one.moved.energy[0],
        "energy": one.moved.energy[1],
        "seconds": one.seconds,
    }


def _show(data: list[dict[str, Any]]) -> None:
    from lgrasp_cli.tables import print_table

    names = ("hand", "object", "rows", "refined", "valid before", "valid", "energy before", "energy", "s")
    rows = [
        (
            one["hand"],
            one["object"],
            f"{one['rows']:,}",
            f"{one['refined']:,}",
            f"{one['valid_before']:,}",
            f"{one['valid']:,}",
            f"{one['energy_before']:.4f}",
            f"{one['energy']:.4f}",
            f"{one['seconds']:.1f}",
        )
        for one in data
    ]
    print_table(names, rows, right=names[2:])
    typer.echo(str(Path(data[0]["shard"]).parent) if data else "")


class _Progress:
    """A line on standard error every few seconds."""

    def __init__(self) -> None:
        self._said = time.monotonic()

    def __call__(self, shard: Path, rows: int, done: int) -> None:
        if done < rows and time.monotonic() - self._said > _INTERVAL:
            self._said = time.monotonic()
            sys.stderr.write(f"{shard.name} {done:,}/{rows:,}\n")
            sys.stderr.flush()
