"""``lgrasp objects``: the objects there are."""

from typing import Annotated

import typer
from typer import Argument

from lgrasp_cli.options import Scale
from lgrasp_cli.tables import Answer, TextTable, reporting

app = typer.Typer(help="List and show objects.", no_args_is_help=True)


@app.command("list")
@reporting
def list_objects() -> Answer:
    """List the objects that can be used by name.

    Example: lgrasp objects list
    """
    from lgrasp.jobs.listing import list_objects as listed

    objects = listed()
    rows = [(o["name"], str(o["faces"] or ""), o["licence"], o["description"] or o["file"]) for o in objects]
    return Answer(objects, [TextTable(("name", "faces", "licence", "description"), rows, right=("faces",))])


@app.command("show")
@reporting
def show_object(
    mesh: Annotated[str, Argument(metavar="NAME", help="Mesh file, or the name of an object.")], scale: Scale = 1.0
) -> Answer:
    """Check a mesh; report its properties and needed repairs.

    Example: lgrasp objects show mug
    """
    from lgrasp.jobs.listing import describe_object

    data = describe_object(mesh, scale)
    pairs = [
        ("object", data["name"]),
        ("file", data["file"]),
        ("faces", f"{data['faces']:,}"),
        ("size", " x ".join(f"{1000 * side:.1f}" for side in data["extents"]) + " mm"),
        ("watertight", "yes" if data["watertight"] else "no"),
        ("sha256", data["sha256"]),
        *(("repaired", note) for note in data["notes"]),
    ]
    return Answer(data, [pairs])
