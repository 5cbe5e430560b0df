"""``lgrasp export``: grasps in the formats of other programs."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from lgrasp_cli.tables import Block, plural
from lgrasp_cli.working import How, working


def register(app: typer.Typer) -> None:
    """Mount the commands of this file."""
    app.command()(working(export))


def export(
    shards: Annotated[list[Path], Argument(help="Shard files, or folders of *.h5 files.")],
    how: How,
    to: Annotated[str, Option("--to", help="dexgraspnet, dexgraspbench, isaac-grasp or mjcf.")],
    out: Annotated[Path, Option("--out", "-o", help="Folder to write; it must be empty or not exist yet.")],
    limit: Annotated[int | None, Option(help="Largest number of grasps.")] = None,
    where: Annotated[
        list[str] | None,
        Option(
            help="Only rows that meet a condition: a column, or COLUMN OP NUMBER, such as objects == 1; repeatable."
        ),
    ] = None,
    only_holding: Annotated[
        bool, Option("--only-holding", help="Only grasps that held in simulation; same as --where physics/fc_holds.")
    ] = False,
) -> None:
    """Write grasps in the format of another program, with the hand's URDF and all meshes.

    Example: lgrasp export grasps/allegro-mug --to isaac-grasp --out mug-isaac --where "metrics/epsilon > 0.01"
    """
    from lgrasp.dataset.exports import HOLDS
    from lgrasp.jobs.export import ExportJob

    conditions = [*(where or ()), *([HOLDS] if only_holding else ())]
    how.run(how.job(ExportJob, "export", shards=shards, out=out, to=to, where=conditions, limit=limit), _show)


def _show(data: dict[str, Any]) -> list[Block]:
    return [f"{data['out']}: {data['grasps']:,} grasps of {plural(len(data['objects']), 'object')}, {data['format']}"]
