"""``lgrasp hands``: the hands there are."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer
from typer import Argument, Option

from lgrasp.choices import MOST_ROWS, ProtocolName, VariationName
from lgrasp.words import plural
from lgrasp_cli.look import view_hand
from lgrasp_cli.names import HANDS, OBJECTS, PIPELINE, one_of
from lgrasp_cli.options import (
    CacheDir,
    Device,
    HandArgument,
    PipelineName,
    Quiet,
    Seed,
    Workers,
    choose_pipeline,
    open_cache,
)
from lgrasp_cli.tables import Answer, Block, TextTable, reporting
from lgrasp_cli.working import How, working

if TYPE_CHECKING:
    from lgrasp.jobs.hand_check.check import HandCheck

app = typer.Typer(name="hands", help="List, show, add and check hands.", no_args_is_help=True)
app.command("view")(view_hand)

_PRIMITIVE = "primitive approximation"


@app.command("list")
@reporting
def list_hands() -> Answer:
    """List the hands that can be used by name, and those in PyPI packages, installed or not.

    Example: lgrasp hands list
    """
    from lgrasp.jobs.listing import list_hands as listed

    hands = listed()
    known, others = [], []
    for hand in hands:
        told = f"{hand['description']} ({_PRIMITIVE})" if hand["approximation"] else hand["description"]
        if hand["package"] is None:
            known.append((hand["name"], told, str(hand["spaces"]), hand["licence"], hand["folder"]))
        else:
            where = "yes" if hand["installed"] else hand["install"]
            others.append((hand["name"], told, hand["package"], where))
    table = TextTable(("name", "description", "spaces", "licence", "folder"), known, right=("spaces",))
    return Answer(hands, [table, "", TextTable(("name", "description", "package", "installed"), others)])


@app.command("show")
@reporting
def show_hand(name: HandArgument) -> Answer:
    """Show fingers, joints, limits and contact rules of a hand.

    Example: lgrasp hands show allegro
    """
    from lgrasp.jobs.hands import describe_hand, types_text

    hand = describe_hand(name)
    box = " to ".join(" ".join(f"{1000 * x:.0f}" for x in hand["canonical_box"][end]) for end in ("min", "max"))
    spaces, types = hand["opposition_spaces"], hand["grasp_types"]
    pairs = [
        ("hand", f"{hand['name']}: {hand['description']}" if hand["description"] else hand["name"]),
        ("file", hand["urdf"]),
        *([("geometry", f"{_PRIMITIVE}; {hand['approximation']}")] if hand["approximation"] else []),
        ("rules", hand["note"] or "hand.yaml"),
        ("base link", hand["base_link"]),
        ("contact links", ", ".join(hand["contact_links"])),
        ("palm", ", ".join(hand["palm_links"]) or "none"),
        *(("shared joint", f"{n}: {', '.join(f'{x:g}' for x in v)}") for n, v in hand["shared"].items()),
        ("canonical box", f"{box} mm"),
        ("opposition spaces", f"{len(spaces)}: {', '.join(spaces)}" if spaces else "none"),
        ("grasp types", types_text(types["makes"])),
        *(("not made", f"{', '.join(names)}: {why}") for why, names in _unmade(types["cannot"]).items()),
        ("licence", hand["licence"] or "not stated"),
        ("source", hand["source"] or "not stated"),
        *(("note", note) for note in hand["notes"]),
    ]
    rows = [
        (
            "shared" if j["finger"] is None else str(j["finger"]),
            j["name"],
            *(f"{j[end]:.3f}" for end in ("lower", "upper")),
            "none" if j["effort"] is None else f"{j['effort']:g}",
        )
        for j in hand["joints"]
    ]
    table = TextTable(("finger", "joint", "lower", "upper", "effort"), rows, right=("lower", "upper", "effort"))
    return Answer(hand, [[(what, " ".join(text.split())) for what, text in pairs], "", table])


def _unmade(cannot: dict[str, str]) -> dict[str, list[str]]:
    """Why grasp types cannot be made -> their names."""
    found: dict[str, list[str]] = {}
    for name, why in cannot.items():
        found.setdefault(why, []).append(name)
    return found


@app.command("add")
def add_hand(
    file: Annotated[Path, Argument(metavar="FILE", exists=True, dir_okay=False, help="URDF or MJCF file of the hand.")],
    name: Annotated[str | None, Option(help="Name of the hand; default: the file's, or LINK.")] = None,
    out: Annotated[Path | None, Option(help="Folder of the hand; default: hands/NAME in your data folder.")] = None,
    overwrite: Annotated[bool, Option("--overwrite", help="Replace the hand of that name.")] = False,
    root: Annotated[
        str | None, Option(metavar="LINK", help="Take only the hand that this link (or body) of a whole robot carries.")
    ] = None,
    mesh_dir: Annotated[
        list[Path] | None, Option(exists=True, file_okay=False, help="Further folder of meshes; repeatable.")
    ] = None,
) -> None:
    """Draft a hand from its URDF or MJCF: fingers, palmar surface, canonical box, open posture.

    \b
    Example: lgrasp hands add my_hand.urdf
    lgrasp hands add robot.urdf --root left_palm --mesh-dir meshes
    """
    from lgrasp.hand.drafting.cut_hand import cut_hand
    from lgrasp.hand.urdf import is_mjcf, read_robot

    if not is_mjcf(file):
        robot, _ = read_robot(file)
        if root is not None:
            cut_hand(file, robot, root)
    from lgrasp.hand.drafting.import_urdf import import_urdf
    from lgrasp_cli.progress import Bar

    with Bar() as bar:
        bar.show("drafting")
        made = import_urdf(file, name=name, out=out, force=overwrite, root=root, mesh_dirs=mesh_dir or ())
    for line in made.decisions:
        typer.echo(f"- {' '.join(line.split())}")
    typer.echo(f"\nwrote {made.folder}")
    typer.echo(f"to change these decisions, edit {made.folder / 'hand.yaml'}; the keys are in brackets above")
    typer.echo(f"try it: lgrasp hands check {made.spec.name if out is None else made.folder}")


@app.command("check")
@reporting
def check_hand(
    name: HandArgument,
    out: Annotated[Path | None, Option(help="Folder of the pictures; default: check/NAME.")] = None,
    rows: Annotated[int, Option("-n", "--rows", min=1, max=MOST_ROWS, help="Grasps requested per object.")] = 200,
    pipeline: PipelineName = "robust",
    device: Device = "auto",
    workers: Workers = 0,
    cache_dir: CacheDir = None,
    quiet: Quiet = False,
) -> Answer:
    """Try a hand on a ball, a box and a cylinder of 5 cm; report where grasps are lost and why, and save pictures.

    Example: lgrasp hands check my_hand
    """
    chosen, cache = choose_pipeline(pipeline), open_cache(cache_dir)
    from dataclasses import asdict

    from lgrasp.jobs.hand_check.check import check_hand as check
    from lgrasp.jobs.hands import hand_source
    from lgrasp_cli.progress import Bar, JobProgress

    folder = out or Path("check") / hand_source(name).name
    how = {"rows": rows, "device": device, "workers": workers, "cache": cache}
    with Bar(quiet=quiet) as bar:
        found = check(name, chosen, out=folder, **how, events=JobProgress(bar, "grasps"))
    stages = list(found.objects[0].survivors)
    rated = [
        [o.name, *(f"{o.survivors[s]:,}" for s in stages), f"{o.rows:,} of {o.asked:,}", f"{o.seconds:.1f}"]
        for o in found.objects
    ]
    columns = ("object", *stages, "grasps", "seconds")
    blocks = [
        *(f"note: {note}" for note in found.notes),
        TextTable(columns, rated, right=columns[1:]),
        *(f"{o.name}: {line}" for o in found.objects for line in o.reasons),
        *(f"could be better: {line}" for line in found.hints),
        *_show_spaces(found),
        *(f"wrote {picture}" for picture in found.pictures),
    ]
    return Answer(asdict(found) | {"pictures": [str(p) for p in found.pictures]}, [] if quiet else blocks)


@app.command("compare")
@working
def compare_hands(
    hands: Annotated[list[str], Argument(help="Names of hands, URDF files, folders, or globs.", **HANDS)],
    how: How,
    objects: Annotated[
        list[str] | None,
        Option(
            "--object",
            "-o",
            help="Name, mesh file, folder or glob; repeatable.",
            show_default="bottle, box, capsule, mug",
            **OBJECTS,
        ),
    ] = None,
    rows: Annotated[int | None, Option("-n", "--rows", help="Grasps per hand and object.", show_default="200")] = None,
    vary: Annotated[
        list[str] | None,
        Option(
            metavar="KIND:VALUES",
            help="Also compare variants of each hand, such as link_scale:0.8,1.2 or joint_limit:+-20%; repeatable; "
            f"kinds: {', '.join(get_args(VariationName))}.",
        ),
    ] = None,
    simulate: Annotated[
        str | None, Option(**one_of(ProtocolName, "PROTOCOL", "Also simulate the grasps (MuJoCo)."))
    ] = None,
    pipeline: Annotated[
        str | None, Option("--pipeline", "-p", help="Name of a pipeline, or a YAML file.", **PIPELINE)
    ] = None,
    seed: Seed = None,
    out: Annotated[Path | None, Option(help="Folder of the shards and of compare.html; default: compare.")] = None,
) -> None:
    """Compare hands, and variants of their design, by their grasps: yield, coverage, diversity, quality, hold test.

    Example: lgrasp hands compare allegro leap --object mug --vary link_scale:0.8,1.2
    """
    from lgrasp.jobs.requests.compare import CompareRequest

    what: dict[str, Any] = {"hands": hands, "objects": objects, "rows": rows, "vary": vary, "simulate": simulate}
    what |= {"pipeline": pipeline, "seed": seed, "out": out}
    how.run(how.job(CompareRequest, "hands compare", **what), _show_comparison, _show_by_object)


def _show_comparison(data: dict[str, Any]) -> list[Block]:
    from lgrasp.jobs.compare.page import HAND_COLUMNS, cells, hand_cells, shown_columns

    columns = shown_columns(data["hands"])
    heads = [head for _, head, _, _ in (*columns, *HAND_COLUMNS)]
    rows = [(hand["hand"], *cells(hand["all"], columns), *hand_cells(hand)) for hand in data["hands"]]
    missing = [("missing", f"{plural(data['missing'], 'hand')} with an object")] if data["missing"] else []
    table = TextTable(("hand", *heads), rows, right=heads)
    return [table, "", [*missing, ("time", f"{data['seconds']['total']:.1f} s"), ("page", str(data["page"]))]]


def _show_by_object(data: dict[str, Any]) -> list[Block]:
    from lgrasp.jobs.compare.page import cells, shown_columns

    columns = shown_columns(data["hands"])
    heads = [head for _, head, _, _ in columns]
    rows = [
        (name, hand["hand"], *cells(hand["objects"][name], columns))
        for name in dict.fromkeys(name for hand in data["hands"] for name in hand["objects"])
        for hand in data["hands"]
        if name in hand["objects"]
    ]
    return ["", TextTable(("object", "hand", *heads), rows, right=heads), ""]


def _show_spaces(found: "HandCheck") -> list[Block]:
    """Opposition spaces: fingers, joints, area of both sides, distances at which these face each other."""
    if not found.spaces:
        return ["no opposition spaces: 'lgrasp sequence' cannot use this hand"]
    rows = []
    for space in found.spaces:
        sides = [x for side, area in zip(space.sides, space.areas, strict=True) for x in (side, f"{1e4 * area:.1f}")]
        apart = "-" if space.low is None or space.high is None else f"{1e3 * space.low:.0f}-{1e3 * space.high:.0f}"
        rows.append([space.name, str(len(space.joints)), *sides, apart])
    columns = ("space", "joints", "side", "cm2", "other", "cm2", "apart, mm")
    return [
        TextTable(columns, rows, right=("joints", "cm2", "apart, mm")),
        *(f"{space.name} can hold nothing: {space.problem}" for space in found.spaces if space.problem),
        f"a sequence holds {plural(found.longest_sequence, 'object')} at most",
    ]
