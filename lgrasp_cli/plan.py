"""``lgrasp plan`` and ``refine``: a local search plans grasps from starts all over a surface, or improves grasps."""

from collections import Counter, defaultdict
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from lgrasp.choices import FormatName
from lgrasp_cli.names import HAND_OR_SHARD, NETWORK, OBJECT_OR_SHARD, one_of
from lgrasp_cli.options import Scale, Settings, Viewpoint, position
from lgrasp_cli.tables import Block, TextTable, closed, ending
from lgrasp_cli.working import How, working


@working
def plan(
    how: How,
    mesh: Annotated[
        str | None, Option("--object", "-o", help="Mesh file, name of an object, or a shard of one.", **OBJECT_OR_SHARD)
    ] = None,
    cloud: Annotated[Path | None, Option(help="Point cloud or scene (.ply .xyz .npy .npz .h5).")] = None,
    mask: Annotated[Path | None, Option(help="Labels of the cloud's points (.npy, .npz).")] = None,
    label: Annotated[int | None, Option(help="Label of the points to grasp.")] = None,
    viewpoint: Viewpoint = None,
    scale: Scale = 1.0,
    hand: Annotated[
        str | None,
        Option(
            help="Name of a hand, a URDF file, a folder with hand.yaml, or a shard (its hand); default: the network's "
            "hand, else allegro.",
            **HAND_OR_SHARD,
        ),
    ] = None,
    model: Annotated[
        str | None,
        Option(help="Network that proposes starting hands: file of learn fit --model grasp, or a name.", **NETWORK),
    ] = None,
    starts: Annotated[int, Option("--starts", "-n", help="Points of the surface to start from.")] = 80,
    stand_off: Annotated[
        float | None, Option(help="Distance of the hand's base from a start in metres; default: the hand's.")
    ] = None,
    distal: Annotated[float, Option(help="Weight of the palmar side of the last links.")] = 1.0,
    other: Annotated[float, Option(help="Weight of the rest of the palmar side; a small value gives pinches.")] = 0.2,
    keep_invalid: Annotated[
        bool, Option("--keep-invalid", help="Where no hand of a start passes, keep the best, with metric 'valid' 0.")
    ] = False,
    settings: Settings = None,
    out: Annotated[Path | None, Option(help="Folder; default: plans/HAND-OBJECT.")] = None,
) -> None:
    """Plan grasps by closing an open hand onto a mesh or point cloud with a local search.

    For each start, the best hand that passes all checks becomes a row. The exit code is 3 if no start gives one.

    Example: lgrasp plan --cloud scene.ply --mask labels.npy --label 3 --hand barrett --starts 80
    """
    from lgrasp.jobs.requests.plan import PlanRequest, plan_params

    what: dict[str, Any] = {"object": mesh, "scale": scale, "cloud": cloud, "mask": mask, "label": label}
    what |= {"viewpoint": position(viewpoint), "hand": hand, "model": model, "starts": starts, "stand_off": stand_off}
    what |= {"keep_invalid": keep_invalid, "out": out}
    params = plan_params(settings or (), distal=distal, other=other)
    how.run(how.job(PlanRequest, "plan", **what, params=params), _show)


def _show(data: dict[str, Any]) -> list[Block]:
    from lgrasp.jobs.refine.plan import lost_starts

    if not data["grasps"]:
        return []
    pairs = [
        ("plans", f"{data['grasps']:,} of {data['starts']:,} starts ({lost_starts(data['counts']) or 'none lost'})"),
        closed(data),
        ("quality", f"median epsilon {data['epsilon']:.3f}, unresisted load {data['unresisted_load']:.2f}"),
        *ending(data, "plans", "render" if data["points"] else "simulate"),
    ]
    return [pairs]


@working
def refine(
    shards: Annotated[list[Path], Argument(help="Shard files, or folders of them; or one export.")],
    how: How,
    out: Annotated[Path, Option(help="Folder of the refined shards.")],
    form: Annotated[
        str | None, Option("--from", **one_of(FormatName, "FORMAT", "Format of the grasps, if not shards."))
    ] = None,
    hand: Annotated[
        str | None, Option(help="Hand of the grasps, for formats without one; shards contain theirs.", **HAND_OR_SHARD)
    ] = None,
    matching_rounds: Annotated[int | None, Option(help="Number of times that nearest points are matched.")] = None,
    gradient_steps: Annotated[int | None, Option(help="Gradient steps after each matching.")] = None,
    outer: Annotated[int | None, Option(hidden=True)] = None,
    inner: Annotated[int | None, Option(hidden=True)] = None,
    coarse: Annotated[
        bool, Option("--coarse", help="Use large steps and a long range, for poses that are far from a grasp.")
    ] = False,
    keep_invalid: Annotated[
        bool, Option("--keep-invalid", help="Keep the refined posture of rows that never pass, with metric 'valid' 0.")
    ] = False,
    settings: Settings = None,
) -> None:
    """Improve grasps by gradient descent on the surface matching energy, check them again, and write shards.

    A refined grasp replaces the original if it passes every check and resists loads better. Rows that pass in neither
    posture are left out. Bounds: those of the shard, or --set bounds.KEY=VALUE.

    Example: lgrasp refine grasps/allegro-mug/robust --out refined/allegro-mug
    """
    from lgrasp.jobs.requests.shards import RefineRequest, refine_params

    rounds = {"matching_rounds": matching_rounds, "gradient_steps": gradient_steps, "outer": outer, "inner": inner}
    params = refine_params(coarse=coarse, **rounds)
    what = {"shards": shards, "out": out, "form": form, "hand": hand, "params": params, "settings": settings}
    how.run(how.job(RefineRequest, "refine", **what, keep_invalid=keep_invalid), _show_refined, _profile)


def _show_refined(data: dict[str, Any]) -> list[Block]:
    names = ("hand", "object", "rows", "refined", "valid before", "valid", "failed")
    sums: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for one in data["results"]:
        sums[one["hand"], one["object"]].update({name: one[name.replace(" ", "_")] for name in names[2:]})
    rows = [(*pair, *(f"{found[name]:,}" for name in names[2:])) for pair, found in sums.items()]
    points = all(one["points"] for one in data["results"])  # which no simulator takes
    following = "" if not any(entry["rows"] for entry in data["results"]) else "render" if points else "simulate"
    pairs = [closed(data), *ending(data, "rows", following)]
    return [TextTable(names, rows, right=names[2:]), pairs]


def _profile(data: dict[str, Any]) -> list[Block]:
    names = ("hand", "object", "energy before", "energy", "s")
    rows = [
        (
            *(one["hand"], one["object"]),
            *("" if one[name] is None else f"{one[name]:.4f}" for name in ("energy_before", "energy")),
            f"{one['seconds']:.1f}",
        )
        for one in data["results"]
    ]
    return [TextTable(names, rows, right=names[2:])]
