"""``lgrasp place``, ``domain``, ``search``, ``ik``, ``filter``: a pipeline up to one stage, from and to the cache."""

from typing import Annotated

import typer
from typer import Option

from lgrasp_cli.options import (
    CacheDir,
    Contacts,
    Device,
    Hand,
    Mesh,
    PipelineName,
    Scale,
    Seed,
    choose_pipeline,
    open_cache,
)
from lgrasp_cli.tables import Answer, TextTable, reporting

_WHAT = {
    "place": "Sample poses of the object in front of the palm, without collision.",
    "domain": "Find the contacts that each finger can make at each pose.",
    "ik": "Move fingers to their contacts and keep those that do not collide with the object.",
    "search": "Combine contacts into sets that balance.",
    "filter": "Complete the grasps and check them exactly.",
}


def register(app: typer.Typer) -> None:
    """Mount the commands of this file."""
    for stage, what in _WHAT.items():
        text = f"{what}\n\nRuns the pipeline up to this stage on one batch of candidates and caches every "
        text += f"table; stages with a cached table are skipped.\n\nExample: lgrasp {stage} --object mug.obj"
        app.command(stage, help=text)(_verb(stage))


def _verb(stage: str):
    def run(
        mesh: Mesh,
        hand: Hand = "allegro",
        pipeline: PipelineName = "robust",
        candidates: Annotated[int, Option(help="Candidates in the batch.")] = 1024,
        first: Annotated[int, Option(help="First candidate of the batch.")] = 0,
        shard_index: Annotated[int, Option(help="Shard whose candidate stream is used.")] = 0,
        seed: Seed = None,
        contacts: Contacts = None,
        scale: Scale = 1.0,
        device: Device = "auto",
        force: Annotated[bool, Option("--force", help="Run every stage again.")] = False,
        cache_dir: CacheDir = None,
    ) -> Answer:
        cache = open_cache(cache_dir, fresh=force)
        from lgrasp.jobs.onestage import run_up_to

        chosen = choose_pipeline(pipeline, seed, contacts)
        runs = run_up_to(stage, chosen, hand, mesh, first, candidates, shard_index, cache, scale=scale, device=device)
        rows = [
            (
                run.stage,
                "hit" if run.hit else "miss",
                f"{run.seconds:.3f}",
                "  ".join(f"{name} {number:,}" for name, number in run.counts.items()),
            )
            for run in runs
        ]
        table = TextTable(("stage", "cache", "seconds", "survivors"), rows, right=("seconds",))
        return Answer([{**vars(run), "path": str(run.path)} for run in runs], [table, str(runs[-1].path)])

    return reporting(run)
