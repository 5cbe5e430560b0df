"""``lgrasp scenes``: tables with objects, images of depth cameras, and feasible grasps."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from lgrasp_cli.names import HAND, OBJECT_OR_SHARD, PIPELINE
from lgrasp_cli.options import given
from lgrasp_cli.tables import Answer, Block, TextTable, checked, counted, following, reporting, took
from lgrasp_cli.working import How, working

app = typer.Typer(
    name="scenes", help="Objects on tables, with point clouds, masks and feasible grasps.", no_args_is_help=True
)

_Paths = Annotated[list[Path], Argument(metavar="SCENES", help="Scene files, or folders of *.h5 files.")]


@app.command()
@working
def make(
    how: How,
    objects: Annotated[
        list[str] | None, Argument(help="Names or mesh files of objects; or one config of scenes.", **OBJECT_OR_SHARD)
    ] = None,
    hand: Annotated[str | None, Option(help="Hand; default: that of --grasps, else allegro.", **HAND)] = None,
    scenes: Annotated[int | None, Option("-n", "--scenes", help="Scenes requested; default: 100.")] = None,
    out: Annotated[Path | None, Option(help="Folder of the scenes; default: scenes.")] = None,
    grasps: Annotated[
        Path | None, Option(help="Folder of shards (lgrasp generate); default: grasps are generated.")
    ] = None,
    pipeline: Annotated[
        str | None, Option("--pipeline", "-p", help="Pipeline that generates the grasps; default: robust.", **PIPELINE)
    ] = None,
    stock: Annotated[int | None, Option(help="Grasps to generate per object; default: 1000.")] = None,
    on_table: Annotated[int | None, Option(help="Objects on a table; default: 5.")] = None,
    views: Annotated[int | None, Option(help="Depth cameras; default: 3.")] = None,
    scale: Annotated[float | None, Option(help="Factor from the meshes' unit to metres.")] = None,
    seed: Annotated[int | None, Option(help="Base seed; default: 0.")] = None,
) -> None:
    """Drop objects on a table, render depth cameras, add grasps and write one file per scene.

    Grasps come from shards (--grasps), or are generated first into OUT/grasps. Those in which the hand would hit
    the table or another object are marked. A scene depends only on its number and the seed.

    Example: lgrasp scenes make mug bowl bottle box sphere hammer --hand allegro -n 100 --out scenes
    """
    from lgrasp.jobs.requests.scenes import SceneRequest

    changes = given(
        hand=hand, scenes=scenes, out=out, grasps=grasps, pipeline=pipeline, stock=stock, scale=scale, seed=seed
    )
    how.run(how.job(SceneRequest, "scenes make", **_config(objects or [], changes, on_table, views)), _show)


@app.command()
@reporting
def check(paths: _Paths) -> Answer:
    """Check every byte and value of each scene against the format, and each folder against its manifest.json.

    Exit code 2 if a file has a problem, or one that is listed is missing.

    Example: lgrasp scenes check scenes
    """
    from lgrasp.dataset.files import find_shards

    find_shards(paths, "scene")
    from lgrasp.dataset.differences import check_files
    from lgrasp.scenes.files import check_scene

    return checked(check_files(paths, check_scene, below=False), "scene")


@app.command()
@reporting
def info(paths: _Paths) -> Answer:
    """Show the numbers of points and grasps in scenes, by object.

    Example: lgrasp scenes info scenes
    """
    from lgrasp.dataset.files import find_shards

    files = find_shards(paths, "scene")
    from lgrasp.jobs.scenes.job import describe_scenes

    data = describe_scenes(files)
    return Answer(data, _blocks(data, [("scenes", f"{data['scenes']:,}")]))


def _config(objects: list[str], changes: dict[str, Any], on_table: int | None, views: int | None) -> dict[str, Any]:
    """The config that is named, or one of the objects, with what the command line replaces."""
    from lgrasp.errors import ConfigError
    from lgrasp.jobs.config import read_scene_config, scene_configs

    config = next((name for name in objects if name.endswith((".yaml", ".yml"))), None)
    if config and len(objects) > 1:
        raise ConfigError(f"{', '.join(objects)}: the config {config} is named alone, or objects without it")
    named = len(objects) == 1 and (config or objects[0] in scene_configs())
    data: dict[str, Any] = read_scene_config(objects[0]) if named else {"objects": objects}
    data |= changes
    scene = data.get("scene") or {}
    if isinstance(scene, dict):  # else the config is refused
        camera = scene.get("camera") or {}
        if views is not None and isinstance(camera, dict):
            scene |= {"camera": camera | {"views": views}}
        data["scene"] = scene | given(objects=on_table)
    return data


def _show(data: dict[str, Any]) -> list[Block]:
    head = [("scenes", counted(data, "scenes")), *took(data, "scenes"), ("where", data["out"])]
    return [*_blocks(data, head), [following("view", data["out"])]]


def _blocks(data: dict[str, Any], head: list[tuple[str, str]]) -> list[Block]:
    scenes, tested = max(data["scenes"], 1), max(data["grasps_tested"], 1)
    table, others = data["grasps_into_table"] / tested, data["grasps_into_objects"] / tested
    pairs = [
        *head,
        ("points", f"{data['points'] / scenes:,.0f} a scene, {data['object_points'] / scenes:,.0f} on objects"),
        ("grasps", f"{data['grasps_tested']:,} tested, {data['grasps_free'] / tested:.1%} collision-free"),
        ("collide", f"{table:.1%} with the table, {others:.1%} with other objects"),
        ("size", f"{data['bytes'] / 1e6 / scenes:.1f} MB a scene"),
    ]
    rows = [
        (
            name,
            f"{found['scenes']:,}",
            f"{found['points'] / found['scenes']:,.0f}",
            f"{found['free']:,}",
            f"{found['kept'] - found['free']:,}",
            f"{found['without']:,}",
        )
        for name, found in data["objects"].items()
    ]
    columns = ("object", "times", "points", "free", "colliding", "without a free one")
    return [pairs, TextTable(columns, rows, right=columns[1:])]
