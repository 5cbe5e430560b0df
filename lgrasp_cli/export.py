"""``lgrasp export``: grasps in the formats of other programs."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lgrasp_cli.options import CacheDir, Quiet, open_cache, warn

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from lgrasp.dataset import ObjectRecord
    from lgrasp.dataset.exports.mjcf import Cut

_PLAIN_INTERVAL = 10.0  # [s] between lines when standard error is no terminal


def register(app: typer.Typer) -> None:
    """Mount the commands of this file."""
    app.command()(export)


def export(
    shards: Annotated[list[Path], typer.Argument(help="Shard files, or folders of *.h5 files.", show_default=False)],
    to: Annotated[
        str, typer.Option("--to", help="dexgraspnet, dexgraspbench, isaac-grasp or mjcf.", show_default=False)
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder to write; empty or not there yet.", show_default=False)
    ],
    limit: Annotated[int | None, typer.Option(help="Most grasps.", show_default=False)] = None,
    where: Annotated[
        list[str] | None,
        typer.Option(
            help="Only rows of which this is true: a column, or COLUMN OP NUMBER, as in objects == 1; may be repeated.",
            show_default=False,
        ),
    ] = None,
    only_holding: Annotated[
        bool, typer.Option("--only-holding", help="Only grasps that held in the simulator: --where physics/fc_holds.")
    ] = False,
    cache_dir: CacheDir = None,
    quiet: Quiet = False,
) -> None:
    """Write grasps in the format of another program, with the hand's URDF and all meshes.

    Example: lgrasp export grasps/allegro-mug --to isaac-grasp --out mug-isaac --where "metrics/epsilon > 0.01"
    """
    from lgrasp.dataset.exports import HOLDS, export_shards

    conditions = [*(where or ()), *([HOLDS] if only_holding else ())]
    cut = _cutter(cache_dir) if to == "mjcf" else None
    with _progress(quiet) as advance:
        done = export_shards(shards, out, to, where=conditions, limit=limit, cut=cut, advance=advance)
    if not quiet:
        objects = f"{len(done.objects)} object{'s' if len(done.objects) > 1 else ''}"
        typer.echo(f"{out}: {done.rows:,} grasps of {objects}, {to}")


def _cutter(cache_dir: Path | None) -> "Cut":
    """Convex pieces of objects as ``lgrasp validate`` makes them, from the cache; approximations are printed."""
    from functools import partial

    from lgrasp.geometry.decompose import decompose
    from lgrasp.simulate.scene import object_of_record

    cache = open_cache(cache_dir)

    def cut(record: "ObjectRecord") -> "Sequence[np.ndarray]":
        solid = object_of_record(record, partial(decompose, store=cache))
        for note in solid.notes:
            warn(f"object '{record.name}': {note}")
        return solid.pieces

    return cut


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A bar on a terminal, else a plain line every ten seconds, or nothing."""
    if quiet or not sys.stderr.isatty():
        said = time.monotonic()

        def advance(done: int, total: int) -> None:
            nonlocal said
            if not quiet and time.monotonic() - said >= _PLAIN_INTERVAL:
                said = time.monotonic()
                typer.echo(f"{done:,}/{total:,} grasps", err=True)

        yield advance
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress("grasps", *columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
