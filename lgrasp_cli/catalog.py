"""``lgrasp objects`` and ``lgrasp pipelines``: what there is."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from lgrasp.choices import ShapeKind
from lgrasp_cli.names import PIPELINE, one_of
from lgrasp_cli.options import MeshArgument, Quiet, Scale
from lgrasp_cli.tables import Answer, TextTable, reporting

objects = typer.Typer(name="objects", help="List, show and make objects.", no_args_is_help=True)
pipelines = typer.Typer(name="pipelines", help="List and show pipelines.", no_args_is_help=True)


@objects.command("list")
@reporting
def list_objects() -> Answer:
    """List the objects that can be used by name.

    Example: lgrasp objects list
    """
    from lgrasp.jobs.listing import list_objects as listed

    found = listed()
    rows = [(o["name"], str(o["faces"] or ""), o["licence"], o["description"] or o["file"]) for o in found]
    return Answer(found, [TextTable(("name", "faces", "licence", "description"), rows, right=("faces",))])


@objects.command("show")
@reporting
def show_object(mesh: MeshArgument, scale: Scale = 1.0) -> Answer:
    """Check a mesh; report its properties and needed repairs.

    Example: lgrasp objects show mug
    """
    from lgrasp.jobs.prepare import describe_object

    data = describe_object(mesh, scale)
    pairs = [
        ("object", data["name"]),
        ("file", data["file"]),
        ("faces", f"{data['faces']:,}"),
        ("size", " x ".join(f"{1000 * side:.1f}" for side in data["extents"]) + " mm"),
        ("volume", f"{1e6 * data['volume']:,.1f} cm³" + ("" if data["solid"] else " (of the convex hull)")),
        ("centre of mass", ", ".join(f"{1000 * x:.1f}" for x in data["center_of_mass"]) + " mm"),
        ("watertight", "yes" if data["watertight"] else "no"),
        ("sha256", data["sha256"]),
        *(("repaired", note) for note in data["notes"]),
    ]
    return Answer(data, [pairs])


@objects.command("make")
@reporting
def make_objects(
    out: Annotated[Path, Option("--out", help="Folder of the meshes.")],
    count: Annotated[int, Option("-n", min=1, max=100_000, help="Objects.")] = 40,
    kinds: Annotated[
        list[str] | None, Option("--kind", **one_of(ShapeKind, "KIND", "Kind of object; repeatable; default all."))
    ] = None,
    size: Annotated[
        str | None, Option(help="Range of the longest side in metres, such as 0.04:0.12; default: that of the kind.")
    ] = None,
    seed: Annotated[int, Option(min=0, max=2**31 - 1, help="The same seed makes the same objects.")] = 0,
    overwrite: Annotated[bool, Option("--overwrite", help="Replace files whose contents differ.")] = False,
    quiet: Quiet = False,
) -> Answer:
    """Make meshes of random sizes: KIND-SEED-NUMBER.obj, watertight, in metres. Existing files are kept.

    Example: lgrasp objects make -n 40 --kind mug --kind bottle --out meshes
    """
    from lgrasp.jobs.make_objects import make_objects as make
    from lgrasp_cli.progress import Bar

    with Bar(quiet=quiet) as bar:
        shown = {"progress": lambda done: bar.show("objects", done, count)}
        data = make(out, count, kinds or (), size=size, seed=seed, overwrite=overwrite, **shown)
    pairs = [("objects", f"{data['objects']:,}, of which {data['written']:,} written now"), ("where", data["out"])]
    return Answer(data, [] if quiet else [pairs])


@pipelines.command("list")
@reporting
def list_pipelines() -> Answer:
    """List the pipelines that can be used by name.

    Example: lgrasp pipelines list
    """
    from lgrasp.jobs.listing import list_pipelines as listed

    found = listed()
    rows = [(p["name"], ", ".join(p["stages"]), p["description"]) for p in found]
    return Answer(found, [TextTable(("name", "stages", "description"), rows)])


@pipelines.command("show")
@reporting
def show_pipeline(name: Annotated[str, Argument(help="Name of a pipeline, or a YAML file.", **PIPELINE)]) -> Answer:
    """Show every parameter of a pipeline: value, what it accepts, meaning.

    Example: lgrasp pipelines show swift
    """
    from lgrasp.jobs.listing import describe_pipeline

    data = describe_pipeline(name)
    head = f"{data['name']}: {data['description']}" if data["description"] else data["name"]
    rows = [
        (part, key, " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value), accepted, words)
        for part, key, value, accepted, words in data["parameters"]
    ]
    return Answer(
        data, [head, TextTable(("part", "parameter", "value", "accepted", "meaning"), rows, right=("value",))]
    )
