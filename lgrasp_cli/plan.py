"""``lgrasp plan``: grasps of an object, or of what is seen of it, from starts all over its surface."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lgrasp_cli.options import CacheDir, Device, JsonPath, Quiet, Scale, check_report, open_cache, warn

if TYPE_CHECKING:
    from lgrasp.jobs.refine.plan import PlanOutcome

_INTERVAL = 5.0  # [s] between lines of progress


def register(app: typer.Typer) -> None:
    """Mount the commands of this file."""
    app.command()(plan)


def plan(
    mesh: Annotated[
        str | None,
        typer.Option("--object", "-o", help="Mesh file, name of an object, or a shard of one.", show_default=False),
    ] = None,
    cloud: Annotated[
        Path | None, typer.Option(help="Point cloud (.ply .xyz .npy .npz .h5), perhaps a scene.", show_default=False)
    ] = None,
    mask: Annotated[
        Path | None, typer.Option(help="Labels of the cloud's points (.npy, .npz).", show_default=False)
    ] = None,
    label: Annotated[int | None, typer.Option(help="Which points are to be grasped.", show_default=False)] = None,
    viewpoint: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Where the cloud was seen from [m]; turns its normals.", show_default=False),
    ] = None,
    scale: Scale = 1.0,
    hand: Annotated[
        str, typer.Option(help="Name of a hand, a URDF file, a folder with hand.yaml, or a shard (its hand).")
    ] = "barrett",
    starts: Annotated[int, typer.Option("--starts", "-n", help="Points of the surface that are tried.")] = 80,
    stand_off: Annotated[
        float | None,
        typer.Option(help="Distance of the hand's base from a start [m]; default: the hand's.", show_default=False),
    ] = None,
    distal: Annotated[float, typer.Option(help="Weight of the palmar side of the last links.")] = 1.0,
    other: Annotated[float, typer.Option(help="Weight of the rest of the palmar side; small: a pinch.")] = 0.2,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder; default: plans/HAND-OBJECT.", show_default=False)
    ] = None,
    device: Device = "auto",
    force: Annotated[bool, typer.Option("--force", help="Replace plans that are there.")] = False,
    json_path: JsonPath = None,
    cache_dir: CacheDir = None,
    quiet: Quiet = False,
) -> None:
    """Plan grasps by a local search from open hands before the surface; a point cloud will do.

    The palm faces each of the starts, the farthest from each other; the best hand of a start that passes all checks
    becomes a row. Exit code 3 when no start gave one.

    Example: lgrasp plan --cloud scene.ply --mask labels.npy --label 3 --hand barrett --starts 80
    """
    check_report(json_path)
    cache = open_cache(cache_dir)
    from lgrasp.cloud.read import read_cloud
    from lgrasp.config import parse_model
    from lgrasp.errors import ConfigError, StarvedError
    from lgrasp.jobs.refine.plan import PlanJob, plan_grasps
    from lgrasp.planning.planner import PlanParams
    from lgrasp.scenes.reader import scene_cloud

    if (mesh is None) == (cloud is None):
        raise ConfigError("give --object (a mesh or a name) or --cloud (a file of points), one of the two")
    given = None
    if cloud is not None:
        given = read_cloud(cloud, mask, label, scale, _numbers(viewpoint), scene=False, read_scene=scene_cloud)
        for note in given.notes:
            warn(note)
    elif mask is not None or label is not None or viewpoint is not None:
        raise ConfigError("--mask, --label and --viewpoint belong to --cloud")
    name = Path(mesh).stem if mesh else f"{Path(str(cloud)).stem}{'' if label is None else f'-{label}'}"
    params = parse_model(PlanParams, {"distal": distal, "other": other}, "plan")
    job = PlanJob(
        hand=hand,
        out=out,
        starts=starts,
        object=mesh,
        scale=scale,
        cloud=given,
        cloud_name=name,
        stand_off=stand_off,
        params=params,
        device=device,
        force=force,
        cache=cache,
    )
    done = plan_grasps(job, None if quiet else _Progress(starts))
    data = _report(done, starts)
    from lgrasp_cli.tables import print_report

    print_report(data, json_path, None if quiet or not data["grasps"] else lambda: _show(data))
    if done.path is None:
        hint = "; do its normals point out of it (--viewpoint), are there views of all sides?" if cloud else ""
        raise StarvedError(f"no grasp planned from {starts} starts: {_lost(done.counts)}{hint}")


def _numbers(text: str | None) -> list[float] | None:
    from lgrasp.errors import ConfigError

    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3:
        raise ConfigError(f"--viewpoint '{text}': three numbers separated by commas, such as 0,0,0.7")
    return numbers


def _report(done: "PlanOutcome", starts: int) -> dict[str, Any]:
    import numpy as np

    metrics = done.grasps.metrics
    return {
        "hand": done.hand,
        "object": done.object.name,
        "starts": starts,
        "grasps": len(done.grasps),
        "counts": done.counts,
        "seconds": done.seconds,
        "epsilon": float(np.median(metrics["epsilon"])) if len(done.grasps) else None,
        "unresisted_load": float(np.median(metrics["unresisted_load"])) if len(done.grasps) else None,
        "out": None if done.path is None else str(done.path),
    }


def _show(data: dict[str, Any]) -> None:
    from lgrasp_cli.tables import print_pairs

    each = data["seconds"] / data["grasps"]
    print_pairs(
        [
            ("plans", f"{data['grasps']:,} of {data['starts']:,} starts ({_lost(data['counts']) or 'none lost'})"),
            ("where", data["out"]),
            ("hand, object", f"{data['hand']}, {data['object']}"),
            ("quality", f"median epsilon {data['epsilon']:.3f}, unresisted load {data['unresisted_load']:.2f}"),
            ("wall", f"{data['seconds']:.1f} s, {each:.3f} s a plan"),
        ]
    )


def _lost(counts: dict[str, int]) -> str:
    return ", ".join(f"{n} {what}" for what, n in counts.items() if what not in ("starts", "kept") and n)


class _Progress:
    """A line on standard error every few seconds."""

    def __init__(self, starts: int) -> None:
        self._starts, self._said = starts, time.monotonic()

    def __call__(self, done: int, plans: int) -> None:
        if done < self._starts and time.monotonic() - self._said > _INTERVAL:
            self._said = time.monotonic()
            sys.stderr.write(f"{done:,}/{self._starts:,} starts  {plans:,} plans\n")
            sys.stderr.flush()
