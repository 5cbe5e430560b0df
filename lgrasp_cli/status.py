"""``lgrasp status``: how far runs are."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from lgrasp_cli.tables import Answer, TextTable, reporting


@reporting
def status(
    folders: Annotated[
        list[Path] | None, Argument(help="Folders of shards or scenes, at any depth; default: this one.")
    ] = None,
    verify: Annotated[bool, Option("--verify", help="Also read the files and compare their SHA-256.")] = False,
) -> Answer:
    """Show how many rows and shards of each run exist, and what is missing or wrong by manifest.json and file sizes.

    States: complete, incomplete, running (a process works on it), starved (no more rows were found), damaged (a file is
    not as it was written), foreign (no run of the folder made these files), unlisted (no manifest.json), bad list (it
    is damaged).

    Example: lgrasp status grasps
    """
    from lgrasp.dataset.status import folder_states

    states = folder_states(folders or [Path()], verify=verify)
    columns = ("folder", "run", "rows", "shards", "state", "next")
    return Answer(states, [TextTable(columns, map(_row, states), right=columns[2:4])])


def _row(run: dict[str, Any]) -> tuple[str, ...]:
    if "job" not in run:
        return (run["folder"], "-", "-", f"{run['shards']:,}", run["state"], run["next"])
    words = [run["job"] or "earlier files", run["hand"], *run["objects"][:2], *["..."][: len(run["objects"]) - 2]]
    words += [run["pipeline"] or "", "" if run["seed"] is None else f"seed {run['seed']}"]
    return (
        run["folder"],
        " ".join(word for word in words if word),
        f"{run['rows']:,}" + ("" if run["asked"] is None else f" of {run['asked']:,}"),
        f"{run['shards']:,} of {run['listed']:,}",
        run["state"],
        run["next"],
    )
