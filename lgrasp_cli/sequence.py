"""``lgrasp sequence``: several objects in one hand, one after another."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from lgrasp.choices import Method, Policy, ProtocolName
from lgrasp_cli.names import OBJECT, PIPELINE, one_of
from lgrasp_cli.options import Hand, Seed, Settings, choose_pipeline
from lgrasp_cli.tables import Block, TextTable, counted, following, held, place, share, took
from lgrasp_cli.working import How, working


@working
def sequence(
    objects: Annotated[list[str], Argument(help="Mesh files or names of objects, in the order of grasping.", **OBJECT)],
    how: How,
    hand: Hand = "allegro",
    rows: Annotated[int, Option("-n", "--rows", help="Complete sequences requested.")] = 256,
    method: Annotated[str | None, Option(**one_of(Method, "METHOD", "Default: the pipeline's."))] = None,
    policy: Annotated[str | None, Option(**one_of(Policy, "POLICY", "Default: the pipeline's."))] = None,
    scale: Annotated[
        str, Option(help="Factor to metres, or range of the longest side in metres such as 0.06:0.10.")
    ] = "1",
    simulate: Annotated[
        str | None,
        Option(**one_of(ProtocolName, "PROTOCOL", "Continue only rows that hold in a simulation.")),
    ] = None,
    pipeline: Annotated[
        str, Option("--pipeline", "-p", help="Name of a pipeline with sequence, or a YAML file.", **PIPELINE)
    ] = "sequence",
    settings: Settings = None,
    out: Annotated[
        Path | None, Option(help="Folder of the shards; default: grasps/HAND-OBJECT-OBJECT.../PIPELINE")
    ] = None,
    seed: Seed = None,
    shard_rows: Annotated[
        int, Option(help="Sequences per shard. Changing it changes which sequences are generated.")
    ] = 1000,
) -> None:
    """Grasp several objects one after another, each with joints that are still free, and write shards.

    Each grasp uses one opposition space of the hand (hand.yaml); joints and objects of earlier grasps stay in place.
    The shards hold the whole sequences and the rows of fewer objects that these continue. The exit code is 3 if fewer
    are found than requested; those found are kept.

    Example: lgrasp sequence mug sphere -n 256 --scale 0.06:0.10
    """
    chosen = choose_pipeline(pipeline, seed, settings=settings)
    if chosen.sequence is not None and (method or policy):
        changes = {"method": method, "policy": policy}
        chosen = chosen.with_params("sequence", **{name: value for name, value in changes.items() if value})
    if out is None:
        from lgrasp.engine.folder import run_folder
        from lgrasp.jobs.config import hand_name
        from lgrasp.jobs.sets import sequence_name

        name = sequence_name(tuple(objects))
        out = run_folder(Path("grasps"), hand_name(hand), name, chosen.name, simulate)
    from lgrasp.jobs.requests.search import SequenceRequest

    what = {"hand": hand, "objects": tuple(objects), "rows": rows, "pipeline": chosen, "out": out}
    what |= {"scale": scale, "simulate": simulate, "shard_rows": shard_rows}
    how.run(how.job(SequenceRequest, "sequence", **what), _show, _profile)


def _show(data: dict[str, Any]) -> list[Block]:
    if not data["sequences"]:
        return []
    pairs = [
        ("sequences", counted(data, "sequences")),
        *held(data),
        *took(data, "sequences"),
        place(data),
        following("render" if data["protocol"] else "simulate --protocol seq6", data["out"]),
    ]
    return [pairs]


def _profile(data: dict[str, Any]) -> list[Block]:
    pairs = [
        ("hand, objects", f"{data['hand']}; {', '.join(data['objects'])}"),
        ("how", f"pipeline {data['pipeline']}, method {data['method']}, policy {data['policy']}"),
        ("penetration", f"median {data['penetration'][0]:.2f} mm, largest {data['penetration'][1]:.2f} mm"),
    ]
    columns = ("object", "space", "sequences", "continued", "share")
    rows = []
    for name, spaces in zip(data["objects"], data["spaces"], strict=False):
        for space, counts in spaces.items():
            tried, held = counts["sequence"]["sequences"], counts["sequence"]["held"]
            rows.append((name, space, f"{tried:,}", f"{held:,}", share(held, tried)))
    return [pairs, TextTable(columns, rows, right=columns[2:])] if data["spaces"] else [pairs]
