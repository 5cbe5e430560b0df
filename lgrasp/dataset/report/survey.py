"""Finds the shards of a data set and tells its hands and objects apart."""

import json
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from lgrasp.dataset.files import Paths, check_heaps, places
from lgrasp.dataset.gather import gather
from lgrasp.dataset.reader import ShardReader
from lgrasp.grasp.bounds import GraspBounds, measured_strictly
from lgrasp.grasp.records import ShardHeader
from lgrasp.words import listed


class Head(NamedTuple):
    """Header of a shard."""

    path: Path
    bytes: int
    rows: int
    hand: tuple[str, str]
    """Name and hash."""
    objects: list[tuple[str, str, float]]
    """Id, hash and scale; sorted by id."""
    labels: list[str]
    """What to call the objects: the id, and more where one id stands for several things."""
    header: ShardHeader
    parts: list[tuple[str, int]]
    """Run and shard index of the rows; several in a merged file."""
    stages: list[str]
    """Of the pipeline, in order; empty if the config does not say."""
    statistics: Mapping[str, int | float | str]


def survey(paths: Paths) -> tuple[list[Head], list[str]]:
    """Heads of all shards, by hand and objects, and remarks on problems.

    Raises:
        ShardError: No shard is found, or one cannot be read.
    """
    heads = [shard.value for shard in gather(paths, _head, invalid=False)]
    meanings: dict[str, set[tuple[str, str, float]]] = defaultdict(set)
    for head in heads:
        for key in head.objects:
            meanings[key[0]].add(key)
    heads = [head._replace(labels=[_label(key, meanings[key[0]]) for key in head.objects]) for head in heads]
    return sorted(heads, key=lambda h: (h.hand, h.labels)), _remarks(heads)


def _head(reader: ShardReader) -> Head:
    check_heaps(reader.path)
    header, attributes, keys = reader.header, reader.attributes, reader.object_keys
    run = header.config.get("run_key") or json.dumps(dict(header.config), sort_keys=True)
    indices = [part["shard_index"] for part in header.merged_from] or [header.shard_index]
    hand = (str(attributes["hand"]), str(attributes["hand_sha256"]))
    try:
        stages = [str(next(iter(stage))) for stage in header.config["pipeline"]["stages"]]
    except (KeyError, TypeError, StopIteration):  # of another writer
        stages = []
    return Head(
        path=reader.path,
        bytes=reader.path.stat().st_size,
        rows=len(reader),
        hand=hand,
        objects=keys,
        labels=[],
        header=header,
        parts=[(f"{hand} {keys} {header.pipeline} {header.seed} {run}", index) for index in indices],
        stages=stages,
        statistics=reader.statistics,
    )


def _label(key: tuple[str, str, float], others: set[tuple[str, str, float]]) -> str:
    name, sha, scale = key
    if len(others) == 1:
        return name
    if len({other[1] for other in others}) == 1:
        return f"{name} (scale {scale:g})"
    return f"{name} ({sha[:6]}, scale {scale:g})"


def _remarks(heads: list[Head]) -> list[str]:
    """Rows that are there twice; empty shards; those made with a higher friction."""
    holder: dict[tuple[str, int], Path] = {}
    twice: set[str] = set()
    for head in heads:
        twice |= {f"{head.path} repeats the rows of {holder[part]}" for part in head.parts if part in holder}
        for part in head.parts:
            holder.setdefault(part, head.path)
    names = places(head.path for head in heads)
    empty = [name for name, head in zip(names, heads, strict=True) if not head.rows]
    rough = [name for name, head in zip(names, heads, strict=True) if not measured_strictly(head.header.config)]
    remarks = []
    if twice:
        remarks.append(f"{listed(sorted(twice), 3)}; they are counted twice.")
    if empty:
        remarks.append(f"No rows are in {listed(empty, 3)}.")
    if rough:
        remarks.append(
            f"Friction was above the strict {GraspBounds().friction:g} in {listed(rough, 3)}: grasps there count as "
            "above the bound of gswo."
        )
    return remarks
