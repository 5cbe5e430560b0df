"""``lgrasp build-field``, ``preprocess``, ``warm-up``, and a pipeline up to one stage: what ends in the cache."""

from typing import Annotated

import typer
from typer import Option

from lgrasp.choices import MOST_BATCH, FieldIndex
from lgrasp.notices import notice
from lgrasp.words import number
from lgrasp_cli.names import one_of
from lgrasp_cli.options import (
    CacheDir,
    Contacts,
    Device,
    Hand,
    HandArgument,
    Mesh,
    MeshArgument,
    PipelineName,
    Scale,
    Seed,
    choose_pipeline,
    open_cache,
)
from lgrasp_cli.tables import Answer, TextTable, reporting

_Rebuild = Annotated[bool, Option("--rebuild", help="Rebuild it even if it is cached.")]


@reporting
def build_field(
    hand: HandArgument,
    index: Annotated[
        str | None, Option(**one_of(FieldIndex, "INDEX", "How the field is looked up; default: the pipeline's."))
    ] = None,
    pipeline: PipelineName = "robust",
    device: Annotated[str | None, Option(hidden=True)] = None,
    cache_dir: CacheDir = None,
    rebuild: _Rebuild = False,
) -> Answer:
    """Build and cache the contact field of a hand.

    Example: lgrasp build-field allegro
    """
    if device is not None:
        notice("--device has no effect: fields are built on the CPU; the option works in this release only")
    cache = open_cache(cache_dir, fresh=rebuild)
    params = choose_pipeline(pipeline, settings=[f"field.index={index}"] if index else None).field
    from lgrasp.jobs.prepare import prepare_field
    from lgrasp_cli.progress import Bar

    with Bar() as bar:
        data = prepare_field(cache, hand, params, report=bar.share)
    clear = "  ".join(number(share, ".0%") for share in data["clear_share"])
    pairs = [
        ("hand", f"{data['hand']}: {data['groups']} fingers, {data['joints']} joints"),
        ("patches", f"{data['patches']:,}"),
        ("contact vectors", f"{data['vectors']:,}"),
        ("index", f"{data['index']}: {data['voxels']:,} voxels of {data['cell'] * 1000:.1f} mm"),
        ("size", f"{data['megabytes']:.1f} MB"),
        ("clear of the palm", f"{clear} of postures, by finger"),
        ("time", f"{data['seconds']:.2f} s" + (" (was cached)" if data["cached"] else "")),
        ("file", data["file"] or "not kept"),
        *(("note", note) for note in data["notes"]),
    ]
    return Answer(data, [pairs])


@reporting
def preprocess(
    mesh: MeshArgument,
    scale: Scale = 1.0,
    pipeline: PipelineName = "robust",
    cache_dir: CacheDir = None,
    rebuild: _Rebuild = False,
) -> Answer:
    """Check and preprocess a mesh, report repairs, and cache the result.

    Example: lgrasp preprocess my_mesh.stl --scale 0.001
    """
    cache = open_cache(cache_dir, fresh=rebuild)
    params = choose_pipeline(pipeline).object
    from lgrasp.jobs.prepare import prepare_object

    data = prepare_object(cache, mesh, params, scale=scale)
    sides = " x ".join(f"{1000 * side:.1f}" for side in data["extents"])
    grid = " x ".join(map(str, data["sdf_shape"]))
    pairs = [
        ("object", f"{data['object']}: {data['faces']:,} faces, {sides} mm"),
        ("watertight", "yes" if data["watertight"] else "no"),
        ("contact points", f"{data['contact_points']:,}"),
        ("obstacle points", f"{data['obstacle_points']:,}"),
        ("distance grid", f"{grid} = {data['sdf_cells']:,} cells of {1000 * data['sdf_cell']:.2f} mm"),
        ("time", f"{data['seconds']:.2f} s" + (" (was cached)" if data["cached"] else "")),
        ("file", data["file"] or "not kept"),
        *(("repaired", note) for note in data["notes"]),
    ]
    return Answer(data, [pairs])


def warm_up(device: Device = "auto", cache_dir: CacheDir = None) -> None:
    """Compile all kernels for a device ahead of the first job.

    Example: lgrasp warm-up --device cuda:0
    """
    open_cache(cache_dir)
    from lgrasp.runtime.device import resolve_device
    from lgrasp.runtime.kernels import first_time, import_all, kernel_modules, load_kernels
    from lgrasp_cli.progress import Bar

    chosen = resolve_device(device)
    import_all()
    modules = kernel_modules()
    with Bar() as bar:
        if words := first_time(chosen.alias, modules):
            bar.say(words)
        load_kernels(chosen.alias, modules, bar.share, preparing=True)
    typer.echo(f"{len(modules)} modules ready on {chosen.alias} ({chosen.name})")


_STAGES = {
    "place": "Sample collision-free poses of the object in front of the palm.",
    "domain": "Find the contacts that each finger can make at each pose.",
    "ik": "Move fingers to their contacts and keep those that do not collide with the object.",
    "wrap": "Lay further links of the touching fingers on the object.",
    "close": "Close fingers until they touch the object.",
    "search": "Combine contacts into sets that balance.",
    "adjust": "Move object and fingers together until the contacts of a set are made.",
    "filter": "Complete the grasps and check them exactly.",
    "hold": "Test in a fast simulation how well finished grasps hold.",
}


def _up_to(stage: str):
    usual = {"hold": "robust-hold", "wrap": "power", "close": "power"}.get(stage, "robust")

    def run(
        mesh: Mesh,
        hand: Hand = "allegro",
        pipeline: PipelineName = usual,
        candidates: Annotated[int, Option(min=1, max=MOST_BATCH, help="Candidates in the batch.")] = 1024,
        first: Annotated[int, Option(min=0, help="First candidate of the batch.")] = 0,
        shard: Annotated[int, Option(min=0, help="Shard whose candidate stream is used.")] = 0,
        seed: Seed = None,
        contacts: Contacts = None,
        scale: Scale = 1.0,
        device: Device = "auto",
        rebuild: Annotated[bool, Option("--rebuild", help="Run every stage again.")] = False,
        cache_dir: CacheDir = None,
    ) -> Answer:
        cache = open_cache(cache_dir, fresh=rebuild)
        chosen = choose_pipeline(pipeline, seed, contacts)
        from lgrasp.jobs.onestage import run_up_to

        runs = run_up_to(stage, chosen, hand, mesh, first, candidates, shard, cache, scale=scale, device=device)
        rows = [
            (
                r.stage,
                "hit" if r.hit else "miss",
                f"{r.seconds:.3f}",
                "  ".join(f"{n} {k:,}" for n, k in r.counts.items()),
            )
            for r in runs
        ]
        table = TextTable(("stage", "cache", "seconds", "survivors"), rows, right=("seconds",))
        return Answer([{**vars(run), "path": str(run.path)} for run in runs], [table, str(runs[-1].path)])

    run.__name__ = stage
    run.__doc__ = f"""{_STAGES[stage]}

    Runs the pipeline up to this stage on one batch of candidates and caches every table; stages with a cached table are
    skipped.

    Example: lgrasp {stage} --object mug
    """
    return reporting(run)


COMMANDS = (build_field, preprocess, warm_up)
STAGES = [_up_to(stage) for stage in _STAGES]
"""The commands named after stages."""
