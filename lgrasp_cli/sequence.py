"""``lgrasp sequence`` and ``lgrasp sample``: several objects in one hand, one after another."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from lgrasp.choices import Method, Policy
from lgrasp_cli.names import HAND, NETWORK, OBJECT, PIPELINE, one_of
from lgrasp_cli.options import Hand, Seed, Settings, Simulate, Viewpoint, choose_pipeline, position
from lgrasp_cli.tables import Block, TextTable, counted, ending, held, share
from lgrasp_cli.working import How, working

Objects = Annotated[list[str], Argument(help="Mesh files or names of objects, in the order of grasping.", **OBJECT)]
Rows = Annotated[int, Option("-n", "--rows", help="Complete sequences requested.")]
PolicyName = Annotated[
    str | None, Option(**one_of(Policy, "POLICY", "How opposition spaces are chosen; default: the pipeline's."))
]
Size = Annotated[str, Option(help="Factor to metres, or range of the longest side in metres such as 0.06:0.10.")]
PipelineName = Annotated[
    str, Option("--pipeline", "-p", help="Name of a sequence pipeline, or a YAML file.", **PIPELINE)
]
Out = Annotated[Path | None, Option(help="Folder of the shards; default: grasps/HAND-OBJECT-OBJECT.../PIPELINE")]
ShardRows = Annotated[int, Option(help="Sequences per shard. Changing it changes which sequences are generated.")]


@working
def sequence(
    objects: Objects,
    how: How,
    hand: Hand = "allegro",
    rows: Rows = 256,
    method: Annotated[
        str | None, Option(**one_of(Method, "METHOD", "How hands are found, by default as the pipeline says."))
    ] = None,
    policy: PolicyName = None,
    scale: Size = "1",
    simulate: Simulate = None,
    pipeline: PipelineName = "sequence",
    settings: Settings = None,
    out: Out = None,
    seed: Seed = None,
    shard_rows: ShardRows = 1000,
) -> None:
    """Grasp several objects one after another, each with joints that are still free, and write shards.

    Each grasp uses one opposition space of the hand (hand.yaml); joints and objects of earlier grasps stay in place.
    The shards hold whole sequences and the shorter ones that they extend.

    Example: lgrasp sequence mug sphere -n 256 --scale 0.06:0.10
    """
    from lgrasp.jobs.requests.search import SequenceRequest

    what: dict[str, Any] = {"hand": hand, "objects": tuple(objects), "rows": rows, "method": method, "policy": policy}
    what |= {"pipeline": choose_pipeline(pipeline, seed, settings=settings), "shard_rows": shard_rows}
    how.run(how.job(SequenceRequest, "sequence", out=out, scale=scale, simulate=simulate, **what), _show, _profile)


@working
def sample(
    model: Annotated[
        str, Argument(help="File written by lgrasp learn fit --model diffuser, or a name from learn list.", **NETWORK)
    ],
    how: How,
    objects: Annotated[
        list[str] | None, Argument(help="Mesh files or names of objects, in the order of grasping.", **OBJECT)
    ] = None,
    cloud: Annotated[
        list[Path] | None, Option(help="Point cloud in place of an object; unseen sides are guessed; repeatable.")
    ] = None,
    mask: Annotated[list[Path] | None, Option(help="Labels of each cloud's points.")] = None,
    label: Annotated[list[int] | None, Option(help="Label to grasp in each cloud.")] = None,
    viewpoint: Viewpoint = None,
    hand: Annotated[
        str | None,
        Option(help="Name of a hand, a URDF file, or a folder with hand.yaml; default: the network's hand.", **HAND),
    ] = None,
    rows: Rows = 256,
    policy: PolicyName = None,
    scale: Size = "1",
    simulate: Simulate = None,
    pipeline: PipelineName = "sample",
    settings: Settings = None,
    out: Out = None,
    seed: Seed = None,
    shard_rows: ShardRows = 1000,
) -> None:
    """Grasp several objects one after another as lgrasp sequence does, with poses and joints drawn by a network.

    What is drawn is moved onto the surfaces and checked; only rows that are strictly valid are written.

    Example: lgrasp sample seq-allegro --cloud mug.npz --cloud ball.ply -n 16
    """
    from lgrasp.jobs.requests.search import SampleRequest

    what: dict[str, Any] = {"model": model, "hand": hand, "objects": objects, "rows": rows, "policy": policy}
    what |= {"pipeline": choose_pipeline(pipeline, seed, settings=settings), "shard_rows": shard_rows}
    what |= {"clouds": cloud, "masks": mask, "labels": label, "viewpoint": position(viewpoint)}
    how.run(how.job(SampleRequest, "sample", out=out, scale=scale, simulate=simulate, **what), _show, _profile)


def _show(data: dict[str, Any]) -> list[Block]:
    if not data["sequences"]:
        return []
    pairs = [
        ("sequences", counted(data, "sequences")),
        *held(data),
        *ending(data, "sequences", "render" if data["protocol"] else "simulate --protocol seq6"),
    ]
    return [pairs]


def _profile(data: dict[str, Any]) -> list[Block]:
    pairs = [
        ("hand, objects", f"{data['hand']}; {', '.join(data['objects'])}"),
        ("how", f"pipeline {data['pipeline']}, method {data['method']}, policy {data['policy']}"),
        ("penetration", f"median {data['penetration'][0]:.2f} mm, largest {data['penetration'][1]:.2f} mm"),
    ]
    columns = ("object", "space", "tried in", "possible", "share")  # a sequence may be tried in several spaces
    rows = []
    for name, spaces in zip(data["objects"], data["spaces"], strict=False):
        for space, counts in spaces.items():
            tried, held = counts["sequences"], counts["held"]
            rows.append((name, space, f"{tried:,}", f"{held:,}", share(held, tried)))
    return [pairs, TextTable(columns, rows, right=columns[2:])] if data["spaces"] else [pairs]
