"""``lgrasp build-field``, ``preprocess`` and ``warm-up``: the preparations of a job."""

from typing import Annotated

import typer
from typer import Argument, Option

from lgrasp_cli.options import CacheDir, Device, PipelineName, Scale, choose_pipeline, open_cache
from lgrasp_cli.tables import Answer, reporting

_Force = Annotated[bool, Option("--force", help="Rebuild it even if it is cached.")]


def register(app: typer.Typer) -> None:
    """Mount the commands of this file."""
    app.command("build-field")(reporting(build_field))
    app.command()(reporting(preprocess))
    app.command("warm-up")(warm_up)


def build_field(
    hand: Annotated[str, Argument(help="Name of a hand, a URDF file, or a folder with hand.yaml.")],
    index: Annotated[str | None, Option(help="voxel or bvh; default: the pipeline's.")] = None,
    pipeline: PipelineName = "robust",
    device: Device = "auto",
    cache_dir: CacheDir = None,
    force: _Force = False,
) -> Answer:
    """Build and cache the contact field of a hand.

    Example: lgrasp build-field allegro
    """
    cache = open_cache(cache_dir, fresh=force)
    from lgrasp.jobs.prepare import prepare_field
    from lgrasp_cli.progress import Bar

    params = choose_pipeline(pipeline).field
    with Bar() as bar:
        data = prepare_field(cache, hand, params, index=index, device=device, report=bar.share)
    note = f"; {data['note']}" if data["note"] else ""
    clear = "  ".join("-" if share is None else f"{share:.0%}" for share in data["clear_share"])
    pairs = [
        ("hand", f"{data['hand']}: {data['groups']} fingers, {data['joints']} joints{note}"),
        ("patches", f"{data['patches']:,}"),
        ("contact vectors", f"{data['vectors']:,}"),
        ("index", f"{data['index']}: {data['voxels']:,} voxels of {data['cell'] * 1000:.1f} mm"),
        ("size", f"{data['megabytes']:.1f} MB"),
        ("clear of the palm", f"{clear} of postures, by finger"),
        ("time", f"{data['seconds']:.2f} s" + (" (was cached)" if data["cached"] else "")),
        ("file", data["file"]),
        *(("note", note) for note in data["notes"]),
    ]
    return Answer(data, [pairs])


def preprocess(
    mesh: Annotated[str, Argument(metavar="OBJECT", help="Mesh file, or the name of an object.")],
    scale: Scale = 1.0,
    pipeline: PipelineName = "robust",
    cache_dir: CacheDir = None,
    force: _Force = False,
) -> Answer:
    """Check and preprocess a mesh, report repairs, and cache the result.

    Example: lgrasp preprocess mug.obj --scale 0.001
    """
    cache = open_cache(cache_dir, fresh=force)
    from lgrasp.jobs.prepare import prepare_object

    data = prepare_object(cache, mesh, choose_pipeline(pipeline).object, scale=scale)
    sides = " x ".join(f"{1000 * side:.1f}" for side in data["extents"])
    grid = " x ".join(map(str, data["sdf_shape"]))
    pairs = [
        ("object", f"{data['object']}: {data['faces']:,} faces, {sides} mm"),
        ("watertight", "yes" if data["watertight"] else "no"),
        ("contact points", f"{data['contact_points']:,}"),
        ("obstacle points", f"{data['obstacle_points']:,}"),
        ("distance grid", f"{grid} = {data['sdf_cells']:,} cells of {1000 * data['sdf_cell']:.2f} mm"),
        ("time", f"{data['seconds']:.2f} s" + (" (was cached)" if data["cached"] else "")),
        ("file", data["file"]),
        *(("repaired", note) for note in data["notes"]),
    ]
    return Answer(data, [pairs])


def warm_up(device: Device = "auto", cache_dir: CacheDir = None) -> None:
    """Compile all kernels for a device ahead of the first job.

    Example: lgrasp warm-up --device cuda:0
    """
    open_cache(cache_dir)
    from lgrasp.runtime.device import resolve_device
    from lgrasp.runtime.kernels import import_all, kernel_modules, load_kernels
    from lgrasp_cli.progress import Bar

    chosen = resolve_device(device)
    import_all()
    modules = kernel_modules()
    with Bar() as bar:
        load_kernels(chosen.alias, modules, bar.share)
    typer.echo(f"{len(modules)} modules ready on {chosen.alias} ({chosen.name})")
