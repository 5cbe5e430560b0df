"""``lgrasp reach``: which grasps can an arm make?"""

from pathlib import Path
from typing import Annotated, Any

from typer import Option

from lgrasp_cli.options import Copies, Shards
from lgrasp_cli.tables import Block, TextTable, following, place, share, took
from lgrasp_cli.working import How, working


@working
def reach(
    shards: Shards,
    how: How,
    arm: Annotated[Path, Option(help="URDF of the arm.")],
    at: Annotated[
        str,
        Option(
            metavar="X,Y,Z[:YAW]",
            help="Pose of the object in the arm's root frame, metres and degrees; also X,Y,Z:ROLL,PITCH,YAW.",
        ),
    ],
    mount: Annotated[
        str | None,
        Option(metavar="X,Y,Z[:R,P,Y]", help="Pose of the hand's base link in the tip's frame."),
    ] = None,
    tip: Annotated[str | None, Option(metavar="LINK", help="Link that carries the hand; default: the last.")] = None,
    tries: Annotated[int | None, Option(min=1, help="Starting postures per pose.")] = None,
    out: Copies = None,
) -> None:
    """Find which grasps an arm can make, and add its joints to the shards, as columns physics/reach_...

    Example: lgrasp reach grasps/allegro-mug/robust-table --arm arm.urdf --at 0.5,0,0
    """
    from lgrasp.jobs.requests.shards import ReachRequest

    what = {"shards": shards, "arm": arm, "at": at, "mount": mount, "tip": tip, "tries": tries, "out": out}
    how.run(how.job(ReachRequest, "reach", **what), _show)


def _show(data: dict[str, Any]) -> list[Block]:
    from lgrasp.reach.targets import CODES

    rows = [
        (entry["hand"], entry["object"], f"{entry['rows']:,}", *(share(entry[name], entry["rows"]) for name in CODES))
        for entry in data["results"]
    ]
    columns = ("hand", "object", "grasps", *(name.replace("_", " ") for name in CODES))
    pairs = [
        ("arm", f"{data['arm']}, {len(data['joints'])} joints, hand on {data['tip']}"),
        *took(data, "grasps"),
        place(data),
        following("dataset report", data["out"]),
    ]
    return [TextTable(columns, rows, right=columns[2:]), pairs]
