"""``lgrasp refine``: grasps moved by a local search, checked again, and written again."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from lgrasp.choices import FormatName
from lgrasp_cli.names import HAND_OR_SHARD, one_of
from lgrasp_cli.options import Settings
from lgrasp_cli.tables import Block, TextTable, closed, following, place, took
from lgrasp_cli.working import How, working


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
    posture are left out. The bounds are those that the shard's rows passed, or --set bounds.KEY=VALUE.

    Example: lgrasp refine grasps/allegro-mug/robust --out refined/allegro-mug
    """
    from lgrasp.jobs.requests.shards import RefineRequest, refine_params

    rounds = {"matching_rounds": matching_rounds, "gradient_steps": gradient_steps, "outer": outer, "inner": inner}
    params = refine_params(coarse=coarse, **rounds)
    what = {"shards": shards, "out": out, "form": form, "hand": hand, "params": params, "settings": settings}
    how.run(how.job(RefineRequest, "refine", **what, keep_invalid=keep_invalid), _show, _profile)


def _show(data: dict[str, Any]) -> list[Block]:
    names = ("hand", "object", "rows", "refined", "valid before", "valid")
    rows = [
        (one["hand"], one["object"], *(f"{one[n.replace(' ', '_')]:,}" for n in names[2:])) for one in data["results"]
    ]
    points = all(one["points"] for one in data["results"])  # which no simulator takes
    pairs = [closed(data), *took(data, "rows"), place(data), following("render" if points else "simulate", data["out"])]
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
