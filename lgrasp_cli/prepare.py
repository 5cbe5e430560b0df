"""``lgrasp build-field``, ``preprocess`` and ``warm-up``: the preparations of a job."""

import sys
import time
from typing import Annotated

import typer

from lgrasp_cli.options import CacheDir, Device, PipelineName, Scale, choose_pipeline, open_cache

_AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of the table.")]
_Force = Annotated[bool, typer.Option("--force", help="Rebuild it even if it is cached.")]


def register(app: typer.Typer) -> None:
    """Mount the commands of this file."""
    app.command("build-field")(build_field)
    app.command()(preprocess)
    app.command("warm-up")(warm_up)


def _progress(what: str, share: float) -> None:
    """One line, rewritten in place, on a terminal; nothing elsewhere."""
    if sys.stderr.isatty():
        end = "\n" if share >= 1.0 else ""
        sys.stderr.write(f"\r\033[K{what} {share:.0%}{end}")
        sys.stderr.flush()


def build_field(
    hand: Annotated[str, typer.Argument(help="Name of a hand, a URDF file, or a folder with hand.yaml.")],
    index: Annotated[
        str | None, typer.Option(help="voxel or bvh; default: the pipeline's.", show_default=False)
    ] = None,
    pipeline: PipelineName = "robust",
    device: Device = "auto",
    cache_dir: CacheDir = None,
    force: _Force = False,
    as_json: _AsJson = False,
) -> None:
    """Build and cache the contact field of a hand.

    Example: lgrasp build-field allegro
    """
    cache = open_cache(cache_dir, fresh=force)
    from lgrasp.jobs.prepare import prepare_field
    from lgrasp_cli.tables import print_json, print_pairs

    data = prepare_field(cache, hand, choose_pipeline(pipeline).field, index=index, device=device, report=_progress)
    if as_json:
        print_json(data)
        return
    f"; {data['note']}" if data["note"] else ""
    clear = "  ".join("-" if share is None else f"{share:.0%}" for share in data["clear_share"])
    print_pairs(
        [
            (
                "hand",
                f"{data['hand']}: {data['groups']} fingers, {data['joints']} joints"
                + (f"; {data['note']}" if data["note"] else ""),
            ),
            ("patches", f"{data['patches']:,}"),
            ("contact vectors", f"{data['vectors']:,}"),
            ("index", f"{data['index']}: {data['voxels']:,} voxels of {data['cell'] * 1000:.1f} mm"),
            ("size", f"{data['megabytes']:.1f} MB"),
            ("clear of the palm", f"{clear} of postures, by finger"),
            ("time", f"{data['seconds']:.2f} s" + (" (was cached)" if data["cached"] else "")),
            ("file", data["file"]),
            *(("note", note) for note in data["notes"]),
        ]
    )


def preprocess(
    mesh: Annotated[str, typer.Argument(metavar="OBJECT", help="Mesh file, or the name of an object.")],
    scale: Scale = 1.0,
    pipeline: PipelineName = "robust",
    cache_dir: CacheDir = None,
    force: _Force = False,
    as_json: _AsJson = False,
) -> None:
    """Check and preprocess a mesh, report repairs, and cache the result.

    Example: lgrasp preprocess mug.obj --scale 0.001
    """
    cache = open_cache(cache_dir, fresh=force)
    from lgrasp.jobs.prepare import prepare_object
    from lgrasp_cli.tables import print_json, print_pairs

    data = prepare_object(cache, mesh, choose_pipeline(pipeline).object, scale=scale)
    if as_json:
        print_json(data)
        return
    sides = " x ".join(f"{1000 * side:.1f}" for side in data["extents"])
    grid = " x ".join(map(str, data["sdf_shape"]))
    print_pairs(
        [
            ("object", f"{data['object']}: {data['faces']:,} faces, {sides} mm"),
            ("watertight", "yes" if data["watertight"] else "no"),
            ("contact points", f"{data['contact_points']:,}"),
            ("obstacle points", f"{data['obstacle_points']:,}"),
            ("distance grid", f"{grid} = {data['sdf_cells']:,} cells of {1000 * data['sdf_cell']:.2f} mm"),
            ("time", f"{data['seconds']:.2f} s" + (" (was cached)" if data["cached"] else "")),
            ("file", data["file"]),
            *(("repaired", note) for note in data["notes"]),
        ]
    )


def warm_up(
    device: Device = "auto",
    cache_dir: CacheDir = None,
) -> None:
    """Compile all kernels for a device ahead of the first job.

    Example: lgrasp warm-up --device cuda:0
    """
    open_cache(cache_dir)
    from lgrasp.runtime.device import resolve_device
    from lgrasp.runtime.kernels import import_all, kernel_modules, load_kernels

    start = time.monotonic()
    chosen = resolve_device(device)
    import_all()
    modules = kernel_modules()

    def done(what: str, share: float) -> None:
        count = f"{round(share * len(modules))}/{len(modules)}"
        typer.echo(f"[{time.monotonic() - start:6.1f} s] {count} {what.removeprefix('kernels ')}")

    load_kernels(chosen.alias, modules, done)
    typer.echo(f"{len(modules)} modules ready on {chosen.alias} ({chosen.name})")
