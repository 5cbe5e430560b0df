"""``lgrasp learn``: networks that guess grasps, from partial clouds or for a hand that holds others."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from lgrasp.choices import NetworkName
from lgrasp.words import plural
from lgrasp_cli.names import HAND, NETWORK, OBJECT, PIPELINE, one_of
from lgrasp_cli.options import CacheDir, Device, Quiet, Shards, choose_pipeline, given, open_cache
from lgrasp_cli.tables import Answer, Block, TextTable, following, reporting, share, took
from lgrasp_cli.working import How, working

app = typer.Typer(name="learn", help="Train and measure networks that predict grasps.", no_args_is_help=True)


@app.command()
@working
def fit(
    how: How,
    shards: Annotated[
        list[Path] | None, Argument(metavar="SHARDS", help="Shard files or folders; none for a pose policy.")
    ] = None,
    model: Annotated[str, Option(**one_of(NetworkName, "NETWORK", "What is trained."))] = "coarse",
    out: Annotated[
        Path | None,
        Option("--out", "-o", help="File of the network; default: coarse.pt, diffuser.pt, grasp.pt or policy.npz."),
    ] = None,
    steps: Annotated[
        int | None, Option(help="Training steps; default: 1500 (coarse) or 20000; grasp: after grasp.completion_steps.")
    ] = None,
    joint_steps: Annotated[
        int | None, Option(help="Training steps through the refiner afterwards (coarse); default: 80.")
    ] = None,
    unrolled: Annotated[int | None, Option(help="Unrolled steps of the refiner (coarse); default: 5.")] = None,
    batch: Annotated[
        int | None, Option(help="Examples per training step; default: 64 (coarse), 512 (pose) or 1024.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        Option("--set", metavar="NETWORK.KEY=VALUE", help="Set a parameter, such as diffuser.width=128; repeatable."),
    ] = None,
    hand: Annotated[str | None, Option(help="Hand of a pose policy; default: allegro.", **HAND)] = None,
    objects: Annotated[
        list[str] | None, Option("--object", help="Objects of a pose policy; default: random shapes.", **OBJECT)
    ] = None,
    pipeline: Annotated[
        str | None, Option("--pipeline", "-p", help="Pipeline of a pose policy; default: robust.", **PIPELINE)
    ] = None,
    seed: Annotated[int, Option(help="Seed of examples, weights and batches.")] = 0,
) -> None:
    """Train a network on grasps.

    grasp draws grasps from a cloud, for lgrasp plan --model. coarse predicts them too, trained through unrolled steps
    of the refiner. diffuser draws the next step of sequences. pose says which poses to search.

    Example: lgrasp learn fit grasps --out coarse.pt

    Example: lgrasp learn fit --model diffuser sequences --device cuda:0
    """
    from lgrasp.config import apply_settings, parse_model
    from lgrasp.errors import ConfigError
    from lgrasp.jobs.requests.learn import PolicyRequest
    from lgrasp.jobs.requests.shards import DiffuserRequest, FitRequest, GraspRequest

    kinds: dict[str, Any] = {
        "coarse": (FitRequest, _show_fit),
        "diffuser": (DiffuserRequest, _show_steps),
        "grasp": (GraspRequest, _show_grasps),
        "pose": (PolicyRequest, _show_policy),
    }
    all_params: dict[str, Any] = {name: taken.model_fields["params"].annotation for name, (taken, _) in kinds.items()}
    (request, show), kind = kinds[model], all_params[model]
    asked: dict[str, Any] = given(hand=hand, objects=objects or None, pipeline=pipeline)
    if model == "pose" and shards:
        raise ConfigError(f"learn fit: {shards[0]}: a pose policy takes no shards, but --hand and --object")
    if model != "pose":
        if asked:
            raise ConfigError(f"learn fit: --{next(iter(asked)).removesuffix('s')} is for --model pose only")
        if not shards:
            raise ConfigError("learn fit: name shards to learn from, or give --model pose")
        asked = {"shards": shards}
    if pipeline:
        asked["pipeline"] = choose_pipeline(pipeline)
    chosen = given(steps=steps, joint_steps=joint_steps, unrolled=unrolled, batch=batch, seed=seed)
    for name in chosen.keys() - kind.model_fields:
        takers = ", ".join(other for other, params in all_params.items() if name in params.model_fields)
        raise ConfigError(
            f"learn fit: --{name.replace('_', '-')} is for --model {takers}; "
            f"--set {model}.KEY=VALUE takes {', '.join(kind.model_fields)}"
        )
    params = apply_settings({model: parse_model(kind, chosen, "learn fit")}, settings or (), "learn fit")[model]
    how.run(how.job(request, "learn fit", **asked, out=out, params=params), show)


@app.command(name="eval")
@reporting
def evaluate(
    predictor: Annotated[str, Argument(help="File written by lgrasp learn fit, or a name from learn list.", **NETWORK)],
    shards: Shards,
    clouds: Annotated[int, Option(min=1, help="New clouds per object (grasp: of each kind).")] = 8,
    starts: Annotated[int, Option("--starts", "-n", min=1, help="Plans per cloud (grasp).")] = 8,
    seed: Annotated[int, Option(min=0, help="Seed of the clouds.")] = 1,
    out: Annotated[Path | None, Option(help="Folder for the plans, as shards of the true meshes (grasp).")] = None,
    overwrite: Annotated[bool, Option("--overwrite", help="Replace plans in the folder.")] = False,
    device: Device = "auto",
    cache_dir: CacheDir = None,
    quiet: Quiet = False,
) -> Answer:
    """Measure a network on shards.

    coarse: the best four answers per new cloud, with their energy by rounds of the refiner and how many are valid
    before and after refine --coarse. grasp: plans from new clouds of all sides and of one side, checked on the true
    meshes. diffuser: the loss, and the penetration of raw draws.

    Example: lgrasp learn eval grasp.pt grasps --out plans
    """
    from lgrasp.errors import ConfigError
    from lgrasp.learn.networks import find_network, read_card

    path, cache = find_network(predictor), open_cache(cache_dir)
    if (kind := read_card(path)["kind"]) == "grasp":
        from lgrasp.jobs.learn.grasp import evaluate as measure_plans

        how: dict[str, Any] = {"clouds": clouds, "starts": starts, "seed": seed, "device": device}
        data = measure_plans(path, shards, cache, **how, out=out, overwrite=overwrite)
        return Answer(data, [] if quiet else [_plans(data), *_of_unknown(data["unknown"])])
    if out is not None:
        raise ConfigError(f"learn eval: --out is for networks of kind grasp; {path} is of kind {kind}")
    if kind == "diffuser":
        from lgrasp.jobs.learn.diffuser import evaluate as measure

        data = measure(path, shards, cache, seed=seed, device=device)
        return Answer(data, [] if quiet else [_draws(data)])
    from lgrasp.jobs.learn.job import evaluate as run

    data = run(path, shards, cache, clouds=clouds, seed=seed, device=device)
    return Answer(data, [] if quiet else [_coarse(data)])


def _coarse(data: dict[str, Any]) -> Block:
    def told(found: dict[str, Any]) -> str:
        words = f"{share(found['valid'], data['poses'])} valid ({data['profile']})"
        if found["valid"]:
            words += f", {share(found['force_closure'], found['valid'])} of them with force closure"
            words += f", mean epsilon {found['epsilon']:.3f}"
        return words

    return [
        ("hand, objects", f"{data['hand']}; {', '.join(data['objects'])}"),
        ("poses", f"{data['poses']:,}"),
        ("coarse", f"{data['coarse']:.4f}"),
        *(
            (f"{steps}-step", f"{energy:.4f}  ({data['coarse'] / energy:.1f}x lower)")
            for steps, energy in zip(data["rounds"], data["refined"], strict=True)
        ),
        ("as predicted", told(data["alone"])),
        ("searched", told(data["searched"])),
    ]


def _draws(data: dict[str, Any]) -> Block:
    def told(found: dict[str, Any]) -> str:
        depth = f"penetration {found['penetration_median']:.2f} mm median, {found['penetration_mean']:.2f} mean"
        return f"{depth}; {found['touching']:.1%} touch and are less than 2 mm deep"

    unknown = f", {len(data['unknown'])} of them not learnt from"
    return [
        ("hand, objects", f"{data['hand']}; {plural(len(data['objects']), 'object')}{unknown}"),
        ("steps", f"{data['examples']:,}, loss {data['loss']:.3f}"),
        ("as drawn", f"{told(data)}, of {data['draws']:,}"),
        ("of the shards", told(data["of_data"])),
        ("time", f"{data['seconds_per_256']:.3f} s for 256 draws"),
    ]


def _of_unknown(unknown: list[str]) -> list[str]:
    return [f"not learnt from: {', '.join(unknown)}" if unknown else "the network learnt from all of these objects"]


def _plans(data: dict[str, Any]) -> TextTable:
    rows = []
    for kind, objects in data["kinds"].items():
        for name, found in objects.items():
            depths = found["penetration"] or [float("nan")] * 2
            share = f"{found['valid'] / max(found['delivered'], 1):.1%}"
            counts = str(found["asked"]), str(found["delivered"])
            rows.append([kind, name, *counts, share, *(f"{1e3 * x:.1f}" for x in depths)])
    numbers = ("asked", "plans", "valid", "depth [mm]", "90 %")
    return TextTable(("cloud", "object", *numbers), rows, right=numbers)


@app.command("list")
@reporting
def list_networks() -> Answer:
    """List networks that can be used by name, and pose policies of hands: what they learnt from, how good they are.

    Example: lgrasp learn list
    """
    from lgrasp.jobs.listing import list_networks as listed

    found = listed()
    rows = []
    for network in found:
        size, report = f"{network['bytes'] / 1e6:.1f} MB", network["report"]
        told = _learnt_from(report), _figures(report)
        rows.append((network["name"], network["kind"], network["hand"], size, *told))
    return Answer(found, [TextTable(("name", "kind", "hand", "size", "learnt from", "figures"), rows, right=("size",))])


@app.command()
@reporting
def show(
    network: Annotated[str, Argument(help="File written by lgrasp learn fit, or a name from learn list.", **NETWORK)],
    plot: Annotated[Path | None, Option(metavar="FILE.png", help="Also draw the losses along its training.")] = None,
) -> Answer:
    """Show the card of a network: what it learnt from, how good it is, the losses along its training.

    Example: lgrasp learn show grasp.pt --plot curve.png
    """
    from lgrasp.errors import ConfigError
    from lgrasp.jobs.listing import describe_network

    data = describe_network(network)
    report, curves = data["report"], data["report"].get("curves", {})
    if plot:
        from lgrasp.learn.curve import draw_curves
        from lgrasp.picture.sheet import check_image

        check_image(plot, (".png",))
        if not curves:
            raise ConfigError(f"{data['file']}: its card has no curve; networks trained with this version have one")
        draw_curves(curves, f"{data['name']}: {data['kind']}, {data['hand']}", plot)
    pairs = [
        ("network", f"{data['file']} ({data['bytes'] / 1e6:.1f} MB)"),
        ("kind, hand", f"{data['kind']}; {data['hand']}"),
        ("learnt from", _learnt_from(report)),
        ("figures", _figures(report)),
    ]
    for part, measured in curves.items():
        pairs += [(f"{part}, {name}", _course(points)) for name, points in measured.items() if points]
    return Answer(data, [[*pairs, *([("plot", str(plot))] if plot else [])]])


def _course(points: list[list[float]]) -> str:
    (_, first), (steps, last) = points[0], points[-1]
    return f"{first:.4g} to {last:.4g} in {plural(int(steps), 'step')}"


def _figures(report: dict[str, Any]) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in report.items() if isinstance(value, float))


def _learnt_from(report: dict[str, Any]) -> str:
    objects, params = report.get("objects", []), report.get("params", {})
    names = objects.split(", ") if isinstance(objects, str) else objects
    named = objects if isinstance(objects, str) and len(names) == 1 else plural(len(names), "object")
    held_out = report.get("unseen", [])
    more = [f"{plural(len(held_out), 'object')} held out"] if held_out else []
    more += [f"{report['examples']:,} examples"] if "examples" in report else []
    more += [f"seed {params['seed']}"] if "seed" in params else []
    return ", ".join([named, *more])


def _show_fit(data: dict[str, Any]) -> list[Block]:
    pairs = [("hand, objects", f"{data['hand']}; {', '.join(data['objects'])}")]
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


def _show_grasps(data: dict[str, Any]) -> list[Block]:
    losses = f"completing {data['completion_loss']:.3f}; drawing {data['loss']:.3f}"
    return _drawing(data, "grasps", losses, following("plan --model", data["out"], " --cloud FILE"))


def _show_steps(data: dict[str, Any]) -> list[Block]:
    after = following("sample", data["out"], " OBJECT OBJECT")
    return _drawing(data, "steps of sequences", f"{data['loss']:.3f}", after)


def _drawing(data: dict[str, Any], examples: str, losses: str, after: tuple[str, str]) -> list[Block]:
    """Of a network that draws hands."""
    seen = f", of {plural(len(data['unseen']), 'unseen object')} {data['unseen_loss']:.3f}" if data["unseen"] else ""
    pairs = [
        ("hand, objects", f"{data['hand']}; {len(data['objects'])} objects, {data['examples']:,} {examples}"),
        ("loss", f"{losses}{seen}"),
    ]
    return [[*pairs, *took(data, "steps"), ("where", data["out"]), after]]


def _show_policy(data: dict[str, Any]) -> list[Block]:
    pairs = [
        ("hand, objects", f"{data['hand']}; {data['objects']}, {data['held_out']} of them held out"),
        ("poses", f"{data['poses']:,}; {data['yielding']:,} gave grasps"),
    ]
    shares = ", ".join(f"{name} {share:.1%}" for name, share in data["sources"].items())
    pairs.append(("sources", f"{shares} of the poses; {data['proposals']} are rated per candidate"))
    words = (("reach", "rated in place"), ("contacts", "after the first contacts"))
    for name, what in words:
        if data[name] is not None:
            pairs.append((what, f"{data[name]:.1%} of pairs of poses in the right order, on held-out objects"))
    use = f"lgrasp generate --hand {data['hand']} --object OBJECT --set place.policy={data['out']}"
    return [[*pairs, *took(data, "objects"), ("where", data["out"]), ("next", use)]]
