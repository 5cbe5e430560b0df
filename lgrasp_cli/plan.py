"""``lgrasp plan``: grasps of an object, or of its visible part, from starts all over its surface."""

from pathlib import Path
from typing import Annotated, Any

from typer import Option

from lgrasp_cli.names import HAND_OR_SHARD, NETWORK, OBJECT_OR_SHARD
from lgrasp_cli.options import Scale, Settings, Viewpoint, position
from lgrasp_cli.tables import Block, closed, following, place, took
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
        float | None, Option(help="Distance of the hand's base from a start [m]; default: the hand's.")
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

    what: dict[str, Any] = {
        "hand": hand,
        "object": mesh,
        "scale": scale,
        "cloud": cloud,
        "mask": mask,
        "label": label,
        "out": out,
    }
    what |= {
        "viewpoint": position(viewpoint),
        "starts": starts,
        "model": model,
        "stand_off": stand_off,
        "keep_invalid": keep_invalid,
    }
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
        *took(data, "plans"),
        place(data),
        following("render" if data["points"] else "simulate", data["out"]),
    ]
    return [pairs]
