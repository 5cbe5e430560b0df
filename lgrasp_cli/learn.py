"""``lgrasp learn``: a small network that guesses grasps from partial clouds, trained through the refiner."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from lgrasp_cli.options import CacheDir, Device, Quiet, Shards, given, open_cache
from lgrasp_cli.tables import Answer, Block, following, reporting, took
from lgrasp_cli.working import How, working

app = typer.Typer(
    name="learn", help="Predict coarse grasps from partial point clouds with a small network.", no_args_is_help=True
)


@app.command()
@working
def fit(
    shards: Shards,
    how: How,
    out: Annotated[Path, Option("--out", "-o", help="File of the predictor.")] = Path("coarse.pt"),
    steps: Annotated[int | None, Option(help="Training steps on poses alone; default: 1500.")] = None,
    joint_steps: Annotated[
        int | None, Option(help="Training steps through the refiner afterwards; default: 80.")
    ] = None,
    unrolled: Annotated[int | None, Option(help="Unrolled steps of the refiner; default: 5.")] = None,
    batch: Annotated[int | None, Option(help="Seeds per training step; default: 64.")] = None,
    seed: Annotated[int, Option(help="Seed of clouds, weights and batches.")] = 0,
) -> None:
    """Train a predictor on the grasps of shards, first on poses, then through unrolled steps of the refiner.

    The report compares energies on clouds outside the training data.

    Example: lgrasp learn fit grasps --out coarse.pt
    """
    from lgrasp.config import parse_model
    from lgrasp.jobs.requests.shards import FitRequest
    from lgrasp.learn.params import LearnParams

    chosen = given(steps=steps, joint_steps=joint_steps, unrolled=unrolled, batch=batch, seed=seed)
    params = parse_model(LearnParams, chosen, "learn fit")
    how.run(how.job(FitRequest, "learn fit", shards=shards, out=out, params=params), _show_fit)


@app.command(name="eval")
@reporting
def evaluate(
    predictor: Annotated[Path, Argument(exists=True, dir_okay=False, help="File written by lgrasp learn fit.")],
    shards: Shards,
    clouds: Annotated[int, Option(min=1, help="New clouds per object.")] = 8,
    seed: Annotated[int, Option(min=0, help="Seed of the clouds.")] = 1,
    device: Device = "auto",
    cache_dir: CacheDir = None,
    quiet: Quiet = False,
) -> Answer:
    """Measure the energy of predictions on new clouds, before and after 3, 6, 10 and 13 rounds of the refiner.

    Example: lgrasp learn eval coarse.pt grasps
    """
    from lgrasp.dataset.files import shards_below

    shards_below(shards)
    cache = open_cache(cache_dir)
    from lgrasp.jobs.learn.job import evaluate as run

    data = run(predictor, shards, cache, clouds=clouds, seed=seed, device=device)
    pairs = [
        ("hand, objects", f"{data['hand']}; {', '.join(data['objects'])}"),
        ("poses", f"{data['poses']:,}"),
        ("coarse", f"{data['coarse']:.4f}"),
        *(
            (f"{steps}-step", f"{energy:.4f}  ({data['coarse'] / energy:.1f}x lower)")
            for steps, energy in zip(data["rounds"], data["refined"], strict=True)
        ),
    ]
    return Answer(data, [] if quiet else [pairs])


def _show_fit(data: dict[str, Any]) -> list[Block]:
    pairs = [
        ("hand, objects", f"{data['hand']}; {', '.join(data['objects'])}"),
    ]
    words = (
        ("frozen", "trained on poses"),
        ("longer", "on poses as many steps more"),
        ("joint", "jointly through the refiner"),
    )
    for name, what in words:
        if found := data.get(name):
            pairs.append((what, f"energy {found['coarse']:.4f}, after the unrolled steps {found['unrolled']:.4f}"))
    if lowered := data.get("lowered"):
        pairs.append(("lowered by", f"{lowered['coarse']:.1%}, after the unrolled steps {lowered['unrolled']:.1%}"))
    end = [*took(data, "steps"), ("where", data["out"]), following("learn eval", data["out"], " SHARDS")]
    return [[*pairs, *end]]
