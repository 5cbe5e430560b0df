"""``lgrasp learn``: networks that guess grasps, from partial clouds or for a hand that holds others."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from lgrasp.choices import NetworkName
from lgrasp_cli.names import one_of
from lgrasp_cli.options import CacheDir, Device, Quiet, Shards, given, open_cache
from lgrasp_cli.tables import Answer, Block, following, reporting, took
from lgrasp_cli.working import How, working

app = typer.Typer(name="learn", help="Train and measure networks that predict grasps.", no_args_is_help=True)


@app.command()
@working
def fit(
    shards: Shards,
    how: How,
    model: Annotated[str, Option(**one_of(NetworkName, "NETWORK", "What is trained."))] = "coarse",
    out: Annotated[
        Path | None, Option("--out", "-o", help="File of the network; default: coarse.pt or diffuser.pt.")
    ] = None,
    steps: Annotated[
        int | None, Option(help="Training steps; default: 1500 (coarse, on poses alone) or 20000 (diffuser).")
    ] = None,
    joint_steps: Annotated[
        int | None, Option(help="Training steps through the refiner afterwards (coarse); default: 80.")
    ] = None,
    unrolled: Annotated[int | None, Option(help="Unrolled steps of the refiner (coarse); default: 5.")] = None,
    batch: Annotated[int | None, Option(help="Examples per training step; default: 64 (coarse), 1024.")] = None,
    settings: Annotated[
        list[str] | None,
        Option("--set", metavar="NETWORK.KEY=VALUE", help="Set a parameter, such as diffuser.width=128; repeatable."),
    ] = None,
    seed: Annotated[int, Option(help="Seed of examples, weights and batches.")] = 0,
) -> None:
    """Train a network on the grasps of shards.

    coarse predicts grasps from partial clouds: it is trained on poses, then through unrolled steps of the refiner; the
    report compares energies on clouds outside the training data. diffuser draws the next step of sequences.

    Example: lgrasp learn fit grasps --out coarse.pt

    Example: lgrasp learn fit --model diffuser sequences --device cuda:0
    """
    from lgrasp.config import apply_settings, parse_model
    from lgrasp.jobs.requests.shards import DiffuserRequest, FitRequest
    from lgrasp.learn.diffuser.params import DiffuserParams
    from lgrasp.learn.params import LearnParams

    request, kind, show = FitRequest, LearnParams, _show_fit
    if model == "diffuser":
        request, kind, show = DiffuserRequest, DiffuserParams, _show_steps
    chosen = given(steps=steps, joint_steps=joint_steps, unrolled=unrolled, batch=batch, seed=seed)
    params = apply_settings({model: parse_model(kind, chosen, "learn fit")}, settings or (), "learn fit")[model]
    how.run(how.job(request, "learn fit", shards=shards, out=out, params=params), show)


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


def _show_steps(data: dict[str, Any]) -> list[Block]:
    seen = "" if data["held_out"] is None else f", on steps held out {data['held_out']:.3f}"
    pairs = [
        ("hand, objects", f"{data['hand']}; {len(data['objects'])} objects, {data['examples']:,} steps of sequences"),
        ("loss", f"{data['loss']:.3f}{seen}"),
    ]
    return [[*pairs, *took(data, "steps"), ("where", data["out"]), following("sample", data["out"], " OBJECT OBJECT")]]
