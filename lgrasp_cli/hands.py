"""``lgrasp hands``: the hands there are."""

from typing import Annotated

import typer

__all__ = ["app"]

app = typer.Typer(help="The hands there are.", no_args_is_help=True)

_AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of the table.")]


@app.command("list")
def list_hands(as_json: _AsJson = False) -> None:
    """List the hands that have a name.

    Example: lgrasp hands list
    """
    from lgrasp.engine.listing import list_hands as listed
    from lgrasp_cli.tables import print_json, print_table

    hands = listed()
    if as_json:
        print_json(hands)
        return
    columns = ("name", "description", "licence", "folder")
    print_table(columns, [[hand[c] for c in columns] for hand in hands])


@app.command("show")
def show_hand(
    name: Annotated[str, typer.Argument(help="Name of a hand, a URDF file, or a folder with hand.yaml.")],
    as_json: _AsJson = False,
) -> None:
    """Show fingers, joints, limits and contact rules of a hand.

    Example: lgrasp hands show allegro
    """
    from lgrasp.engine.listing import describe_hand
    from lgrasp_cli.tables import print_json, print_pairs, print_table

    hand = describe_hand(name)
    if as_json:
        print_json(hand)
        return
    box = " to ".join(" ".join(f"{1000 * x:.0f}" for x in hand["canonical_box"][end]) for end in ("min", "max"))
    pairs = [
        ("hand", f"{hand['name']}: {hand['description']}" if hand["description"] else hand["name"]),
        ("file", hand["urdf"]),
        ("rules", hand["note"] or "hand.yaml"),
        ("base link", hand["base_link"]),
        ("contact links", ", ".join(hand["contact_links"])),
        ("palm", ", ".join(hand["palm_links"]) or "none"),
        ("canonical box", f"{box} mm"),
        ("licence", hand["licence"] or "not stated"),
        ("source", hand["source"] or "not stated"),
        *(("note", note) for note in hand["notes"]),
    ]
    print_pairs([(what, " ".join(text.split())) for what, text in pairs])
    typer.echo()
    rows = [(str(j["finger"]), j["name"], f"{j['lower']:.3f}", f"{j['upper']:.3f}") for j in hand["joints"]]
    print_table(("finger", "joint", "lower", "upper"), rows, right=("lower", "upper"))
