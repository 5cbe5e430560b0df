"""``lgrasp generate``: the main job."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from lgrasp.choices import MOST_BATCH, PalmUse, ScoreName, ThumbPlace
from lgrasp.words import plural
from lgrasp_cli.many import run_all, show_plans
from lgrasp_cli.names import GRASP_TYPE, HANDS, OBJECTS, one_of
from lgrasp_cli.options import (
    Contacts,
    DryRun,
    PipelineName,
    Scale,
    Seed,
    Settings,
    Simulate,
    choose_pipeline,
    given,
    refuse_twice,
)
from lgrasp_cli.tables import Block, closed, counted, ending, held
from lgrasp_cli.working import How, working

_LIKELY = 0.05  # probability of a resting pose that is named when it has no grasps

_steers = partial(Option, rich_help_panel="Steer")

GraspType = Annotated[
    str | None, _steers(help="Grasp type, such as tripod; lgrasp hands show lists a hand's.", **GRASP_TYPE)
]
Fingers = Annotated[
    str | None, _steers(metavar="NAMES", help="Fingers that must all touch, and no others, such as thumb,index.")
]
Links = Annotated[
    str | None,
    _steers(
        metavar="NAMES", help="The only links that may touch; LINK:radial, LINK:ulnar or LINK:tip: only with that side."
    ),
]
Palm = Annotated[str | None, _steers(**one_of(PalmUse, "PALM", "Whether the palm may or must touch."))]
Thumb = Annotated[
    str | None, _steers(**one_of(ThumbPlace, "PLACE", "Where the thumb is: across the palm or along it."))
]
Approach = Annotated[
    str | None,
    _steers(
        metavar="X,Y,Z:DEG",
        help="Directions that the palm may face, a cone in the object's frame; 0,0,-1:30 is from above.",
    ),
]
Above = Annotated[
    str | None,
    _steers(
        metavar="X,Y,Z,D", help="Keep the hand and its approach where X x + Y y + Z z >= D (object's frame, metres)."
    ),
]
PoseFile = Annotated[
    Path | None,
    _steers(
        "--pose",
        metavar="FILE",
        help="Object poses in the hand's frame (npz, csv or a shard); only fingers are searched.",
    ),
]
Touch = Annotated[
    list[str] | None,
    _steers(
        metavar="REGION",
        help="Region that must contain all contacts (with :0.7 appended, 70 % of the force): box:x0,y0,z0:x1,y1,z1, "
        "sphere:x,y,z:r, group:NAME, color:#rrggbb, a closed mesh, an .npz of weights per vertex; repeatable.",
    ),
]
Avoid = Annotated[list[str] | None, _steers(metavar="REGION", help="Region without contacts; repeatable.")]


@working
def generate(
    meshes: Annotated[
        list[str],
        Option(
            "--object",
            "-o",
            help="Mesh file, name of an object, folder of meshes, or glob in quotes; repeatable.",
            **OBJECTS,
        ),
    ],
    how: How,
    hands: Annotated[
        list[str],
        Option(
            "--hand",
            help="Name of a hand, URDF file, folder with hand.yaml or of such folders, or glob in quotes; repeatable.",
            **HANDS,
        ),
    ] = ["allegro"],  # noqa: B006 as typer takes it
    rows: Annotated[int, Option("-n", "--rows", help="Grasps requested.")] = 1000,
    pipeline: PipelineName = "robust",
    settings: Settings = None,
    out: Annotated[
        Path | None,
        Option(
            help="Folder of the shards (several jobs: of folders HAND-OBJECT/PIPELINE); "
            "default: grasps/HAND-OBJECT/PIPELINE."
        ),
    ] = None,
    seed: Seed = None,
    contacts: Contacts = None,
    scale: Scale = 1.0,
    batch: Annotated[int, Option(min=0, max=MOST_BATCH, help="Candidates per batch; 0: as suits the device.")] = 0,
    simulate: Simulate = None,
    shard_rows: Annotated[
        int,
        Option(help="Grasps per shard, which tries whole batches. Changing it changes which grasps are generated."),
    ] = 10_000,
    passes: Annotated[
        int | None,
        Option(
            min=1,
            max=64,
            help="Searches per successful pose; more are faster, but give fewer poses; default: the pipeline's.",
        ),
    ] = None,
    score: Annotated[
        str | None,
        Option(**one_of(ScoreName, "SCORE", "Residual that the search minimises, without or with friction.")),
    ] = None,
    grasp_type: GraspType = None,
    fingers: Fingers = None,
    links: Links = None,
    palm: Palm = None,
    thumb: Thumb = None,
    approach: Approach = None,
    above: Above = None,
    pose: PoseFile = None,
    touch: Touch = None,
    avoid: Avoid = None,
    table: Annotated[bool, Option("--table", help="Leave room for the table that the object rests on.")] = False,
    negatives: Annotated[
        float, Option(min=0, max=100, metavar="SHARE", help="Failed rows to keep per grasp, with metric 'valid' 0.")
    ] = 0.0,
    dry_run: DryRun = False,
) -> None:
    """Generate grasps of an object and write them as shards.

    With several objects or hands, every pair is a job; one that fails does not stop the others.

    Example: lgrasp generate --object mug --object bowl --object "meshes/*.obj" -n 10000
    """
    from lgrasp.errors import ConfigError
    from lgrasp.hand.names import all_hands
    from lgrasp.jobs.config import pair_requests
    from lgrasp.object.find import all_objects

    searching = given(contacts=contacts, passes=passes, score=score)
    steering = given(grasp_type=grasp_type, fingers=fingers, links=links, palm=palm, thumb=thumb)
    steering |= given(approach=approach, above=above, pose=pose, touch=touch or None, avoid=avoid or None)
    told = {f"search.{name}": name for name in searching} | {f"steer.{name}": name for name in steering}
    told |= {"place.table": "table"} if table else {}
    if fingers or grasp_type:
        told["search.contacts"] = "fingers" if fingers else "grasp-type"
    refuse_twice(settings, told)
    chosen = choose_pipeline(pipeline, seed, contacts, settings)
    chosen = chosen.with_params("search", **given(passes=passes, score=score))
    chosen = chosen.with_simulation(simulate) if simulate else chosen
    chosen = chosen.with_table() if table else chosen
    chosen = chosen.with_steering(**steering)
    for name in ("fingers", "grasp_type") if contacts is not None else ():
        if getattr(chosen.steer, name):
            flag = f"--{name.replace('_', '-')}"
            raise ConfigError(f"--contacts {contacts}: {flag} says already how many touch; give one of them")
    pairs = all_hands(hands), all_objects(meshes)
    what = {"rows": rows, "scale": scale, "batch": batch, "shard_rows": shard_rows, "negatives": negatives}
    requests = pair_requests(*pairs, chosen, out or Path("grasps"), simulate, **what, **how.shared)
    if len(requests) > 1 or pairs != (tuple(hands), tuple(meshes)):
        run_all(requests, how, dry_run=dry_run)
        return
    request = requests[0].model_copy(update={"out": out}) if out else requests[0]
    if dry_run:
        show_plans([request], how)
    else:
        how.run(how.checked(request), _show, _profile)


def _show(data: dict[str, Any]) -> list[Block]:
    near, looser = data["near_duplicates"], data["grasps"] - data["strict"]
    after = "render" if data["protocol"] else "simulate"
    pairs = [
        ("grasps", counted(data, "grasps")),
        *held(data),
        *([("negatives", f"{data['negatives']:,} rows that fail a bound")] if "negatives" in data else ()),
        ("diversity", f"{plural(data['distinct_poses'], 'object pose')}, {plural(near, 'near-duplicate')}"),
        closed(data),
        *_resting(data.get("resting", [])),
        *([("strict bounds", f"{looser:,} grasps meet only those of the pipeline")] if looser else ()),
        *ending(data, "grasps", after if data["grasps"] else ""),
    ]
    return [pairs]


def _resting(poses: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """How many resting poses of the object have grasps, and which likely ones have none."""
    if not poses:
        return []
    without = [(k, p["probability"]) for k, p in enumerate(poses) if not p["rows"]]
    likely = ", ".join(f"{k} ({100 * share:.0f} %)" for k, share in without if share >= _LIKELY)
    none = f"; none: {likely}" if likely else ""
    return [("resting poses", f"{len(poses) - len(without)} of {len(poses)} have grasps{none}")]


def _profile(data: dict[str, Any]) -> list[Block]:
    stages, seconds = list(data["counts"]), data["seconds"]
    pairs = [
        ("hand, object", f"{data['hand']}, {data['object']}; pipeline {data['pipeline']}, seed {data['seed']}"),
        ("survivors", "  ".join(f"{name} {data['survivors'][name]:,}" for name in stages)),
        ("search", f"{seconds['wall']:.2f} s from placement through filter"),
        ("strict-valid", f"{data['strict_valid_per_s']:,.0f} /s ({data['strict']:,})"),
        ("by own bounds", f"{data['grasps_per_s']:,.0f} /s ({data['grasps']:,})"),
        ("published count", f"{data['published_count_per_s']:,.0f} /s ({data['published_count']:,})"),
    ]
    return [pairs]
