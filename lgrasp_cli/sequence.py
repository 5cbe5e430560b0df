"""``lgrasp sequence``: several objects in one hand, one after another."""

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from lgrasp_cli.options import Hand, Seed, Settings, choose_pipeline
from lgrasp_cli.tables import Block, TextTable, counted, place, share
from lgrasp_cli.working import How, working


@working
def sequence(
    objects: Annotated[list[str], Argument(help="Mesh files or names of objects, in the order of grasping.")],
    how: How,
    hand: Hand = "allegro",
    rows: Annotated[int, Option("-n", "--rows", help="Complete sequences requested.")] = 256,
    method: Annotated[str | None, Option(help="field, anneal or mala; default: the pipeline's.")] = None,
    policy: Annotated[str | None, Option(help="uniform or lookahead; default: the pipeline's.")] = None,
    scale: Annotated[
        str, Option(help="Factor to metres, or range of the longest side in metres such as 0.06:0.10.")
    ] = "1",
    simulate: Annotated[
        str | None, Option(help="Continue only rows that hold in simulation: seq6 or seq6_mu06.")
    ] = None,
    pipeline: Annotated[
        str, Option("--pipeline", "-p", help="Name of a pipeline with sequence, or a YAML file.")
    ] = "sequence",
    settings: Settings = None,
    out: Annotated[Path | None, Option(help="Folder of the shards; default: grasps/HAND-OBJECT-OBJECT...")] = None,
    seed: Seed = None,
    shard_rows: Annotated[
        int, Option(help="Sequences per shard. Changing it changes which sequences are generated.")
    ] = 1000,
) -> None:
    """Grasp several objects one after another, each with joints that are still free, and write shards.

    Each grasp uses one opposition space of the hand (hand.yaml); joints and objects of earlier grasps stay in place.
    The shards hold the whole sequences and the rows of fewer objects that these continue. Exit code 3 when fewer
    than asked were found; what was found is kept.

    Example: lgrasp sequence mug sphere -n 256 --scale 0.06:0.10
    """
    from lgrasp.jobs.hands import hand_source
    from lgrasp.jobs.sequence.job import SequenceJob, sequence_name

    chosen = choose_pipeline(pipeline, seed, settings=settings)
    if chosen.sequence is not None and (method or policy):
        changes = {"method": method, "policy": policy}
        chosen = chosen.with_params("sequence", **{name: value for name, value in changes.items() if value})
    out = out or Path("grasps") / sequence_name(hand_source(hand).name, tuple(objects))
    what = {"hand": hand, "objects": tuple(objects), "rows": rows, "pipeline": chosen, "out": out}
    what |= {"scale": scale, "simulate": simulate, "shard_rows": shard_rows}
    how.run(how.job(SequenceJob, "sequence", **what), _show)


def _show(data: dict[str, Any]) -> list[Block]:
    if not data["sequences"]:
        return []
    pairs = [
        ("sequences", counted(data, "sequences")),
        place(data),
        ("hand, objects", f"{data['hand']}; {', '.join(data['objects'])}"),
        ("how", f"pipeline {data['pipeline']}, method {data['method']}, policy {data['policy']}"),
        ("wall", f"{data['seconds']['total']:.2f} s, {data['seconds']['wall']:.2f} s of it the sequences"),
        ("penetration", f"median {data['penetration'][0]:.2f} mm, largest {data['penetration'][1]:.2f} mm"),
        ("device", data["device"]),
    ]
    columns = ("object", "space", "sequences", "continued", "share")
    rows = []
    for name, spaces in zip(data["objects"], data["spaces"], strict=False):
        for space, counts in spaces.items():
            tried, held = counts["sequence"]["sequences"], counts["sequence"]["held"]
            rows.append((name, space, f"{tried:,}", f"{held:,}", share(held, tried)))
    return [pairs, TextTable(columns, rows, right=columns[2:])] if data["spaces"] else [pairs]
