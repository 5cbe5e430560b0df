"""``lgrasp bench refine``: planning and refining by local search beside the published figures."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from lgrasp_cli.options import CacheDir, Device, JsonPath, check_report, open_cache

if TYPE_CHECKING:
    from lgrasp.bench.refine import HandBench


def bench_refine(
    hands: Annotated[str, typer.Option(help="Names, separated by commas.")] = "barrett,schunk_svh",
    objects: Annotated[str, typer.Option(help="Names or mesh files, separated by commas.")] = "bowl,box,bottle,mug",
    starts: Annotated[int, typer.Option("--starts", "-n", min=1, help="Starts on each object.")] = 80,
    physics: Annotated[str, typer.Option(help="Protocol that decides what is valid.")] = "fc",
    noise: Annotated[bool, typer.Option("--noise/--no-noise", help="Table IV too: clouds with noise.")] = True,
    device: Device = "auto",
    json_path: JsonPath = None,
    cache_dir: CacheDir = None,
) -> None:
    """Plan on objects and on noisy clouds of them, refine coarse poses, and print the paper's tables I, III and IV.

    A plan counts as valid when it holds its object in simulation. The paper's objects are others; its time is an RTX
    3080's.

    Example: lgrasp bench refine --objects bottle,mug --starts 40
    """
    check_report(json_path)
    cache = open_cache(cache_dir)
    from lgrasp.bench.refine import NOISES, bench_hand
    from lgrasp_cli.tables import print_report

    names = [name.strip() for name in objects.split(",")]
    results = [
        bench_hand(
            hand.strip(),
            names,
            starts,
            protocol=physics,
            noises=NOISES if noise else (),
            device=device,
            cache=cache,
            progress=lambda line: typer.echo(line, err=True),
        )
        for hand in hands.split(",")
    ]
    data = [_plain(one) for one in results]
    print_report(data, json_path, lambda: _show(results, names, starts))


def _plain(one: "HandBench") -> dict[str, Any]:
    from lgrasp.bench.refine import PUBLISHED, STEPS

    planning = {"mesh": one.mesh, **{f"cloud_{1e3 * noise:g}_mm": p for noise, p in one.clouds.items()}}
    return {
        "hand": one.hand,
        "planning": {
            name: {**p._asdict(), "share": p.share, "seconds_each": p.seconds_each} for name, p in planning.items()
        },
        "steps": list(STEPS),
        "energy": list(one.energy),
        "milliseconds": list(one.milliseconds),
        "poses": one.poses,
        "published": PUBLISHED.get(one.hand),
    }


def _show(results: "list[HandBench]", objects: list[str], starts: int) -> None:
    from lgrasp.bench.refine import PUBLISHED, STEPS
    from lgrasp_cli.tables import print_table

    typer.echo(f"{starts} starts on each of {', '.join(objects)}")
    typer.echo("\nTable I: plans on meshes")
    columns = ("hand", "epsilon", "paper", "valid", "paper", "s each", "paper", "planned")
    rows = []
    for one in results:
        paper = PUBLISHED.get(one.hand)
        own = (f"{one.mesh.epsilon:.3f}", f"{one.mesh.share:.1%}", f"{one.mesh.seconds_each:.2g}")
        says = ("-",) * 3
        if paper:
            says = (f"{paper['epsilon']:.3f}", f"{paper['valid'][0]:.1%}", f"{paper['seconds'][0]:.2g}")
        pairs = [text for pair in zip(own, says, strict=True) for text in pair]
        rows.append((one.hand, *pairs, f"{one.mesh.planned / one.mesh.starts:.1%}"))
    print_table(columns, rows, right=columns[1:])
    typer.echo("\nTable III: energy of coarse poses after outer steps (paper's: 1e-5 of its own unit)")
    columns = ("hand", "whose", *map(str, STEPS), "falls", "ms")
    rows = []
    for one in results:
        rows.append(
            (
                one.hand,
                f"ours, {one.poses} poses",
                *(f"{e:.4f}" for e in one.energy),
                _falls(one.energy),
                f"{one.milliseconds[-1]:.1f}",
            )
        )
        if one.hand in PUBLISHED:
            energy = PUBLISHED[one.hand]["energy"]
            rows.append((one.hand, "paper", *(f"{e:.0f}" for e in energy), _falls(energy), "-"))
    print_table(columns, rows, right=columns[2:])
    if any(one.clouds for one in results):
        typer.echo("\nTable IV: plans on points of the surface, by noise")
        noises = list(results[0].clouds)
        columns = ("hand", "whose", *(f"{1e3 * noise:g} mm" for noise in noises), "kept")
        rows = []
        for one in results:
            shares = [p.share for p in one.clouds.values()]
            rows.append((one.hand, "ours", *(f"{s:.1%}" for s in shares), _kept(shares)))
            rows.append((one.hand, "ours, s each", *(f"{p.seconds_each:.2g}" for p in one.clouds.values()), ""))
            if one.hand in PUBLISHED:
                valid = PUBLISHED[one.hand]["valid"]
                rows.append((one.hand, "paper", *(f"{s:.1%}" for s in valid), _kept(list(valid))))
        print_table(columns, rows, right=columns[2:])


def _falls(energy: Any) -> str:
    return f"{energy[0] / energy[-1]:.1f}x" if energy[-1] else "-"


def _kept(shares: list[float]) -> str:
    return f"{shares[-1] / shares[0]:.0%}" if shares[0] else "-"
