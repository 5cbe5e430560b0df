"""``lgrasp objects``: the objects there are."""

from typing import Annotated

import typer

from lgrasp_cli.options import Scale

app = typer.Typer(help="List and show objects.", no_args_is_help=True)

_AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of the table.")]


@app.command("list")
def list_objects(as_json: _AsJson = False) -> None:
    """List the objects that can be used by name.

    Example: lgrasp objects list
    """
    from lgrasp.jobs.listing import list_objects as listed
    from lgrasp_cli.tables import print_json, print_table

    objects = listed()
    if as_json:
        print_json(objects)
        return
    rows = [(o["name"], str(o["faces"] or ""), o["licence"], o["description"] or o["file"]) for o in objects]
    print_table(("name", "faces", "licence", "description"), rows, right=("faces",))


@app.command("show")
def show_object(
    mesh: Annotated[str, typer.Argument(metavar="NAME", help="Mesh file, or the name of an object.")],
    scale: Scale = 1.0,
    as_json: _AsJson = False,
) -> None:
    """Check a mesh; report its properties and needed repairs.

    Example: lgrasp objects show mug
    """
    from lgrasp.jobs.listing import describe_object
    from lgrasp_cli.tables import print_json, print_pairs

    data = describe_object(mesh, scale)
    if as_json:
        print_json(data)
        return
    print_pairs(
        [
            ("object", data["name"]),
            ("file", data["file"]),
            ("faces", f"{data['faces']:,}"),
            ("size", " x ".join(f"{1000 * side:.1f}" for side in data["extents"]) + " mm"),
            ("watertight", "yes" if data["watertight"] else "no"),
            ("sha256", data["sha256"]),
            *(("repaired", note) for note in data["notes"]),
        ]
    )
