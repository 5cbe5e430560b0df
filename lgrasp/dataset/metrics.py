"""Further quality numbers of stored grasps, computed from the shards alone on all cores."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from lgrasp.dataset.reader import ShardReader
from lgrasp.dataset.validate import validate_shard
from lgrasp.errors import OutputError, ShardError
from lgrasp.grasp.records import GraspRows, ObjectRecord
from lgrasp.grasp.wrench_space import wrench_spaces
from lgrasp.object.mass import mass_properties
from lgrasp.runtime.processes import ProcessPool

METRICS = {"epsilon_exact": "", "volume": ""}
"""Units of the metrics that can be added (docs/reference/metrics.md defines them)."""

MEASURED = "_measured"
"""End of the names of statistics that tell with which numbers a metric was measured."""

TASK_ROWS = 32
_ROW = ("candidate", "q", "contact_points")  # what tells rows apart
_Map = Callable[..., Iterable[np.ndarray]]


def measure_shard(
    path: Path, friction: float, each: _Map, step: int, report: Callable[[int], None]
) -> dict[str, np.ndarray]:
    """All metrics of a shard by name, each shape [N]; ``step`` rows at a time, ``report`` is called with rows done.

    Args:
        each: As of :func:`row_metrics`.

    Raises:
        ShardError: The shard does not conform; with its first problem.
    """
    for problem in validate_shard(path):
        raise ShardError(f"{path}: {problem}")
    with ShardReader(path) as reader:
        frames = [mass_frame(record) for record in reader.objects()]
        table = np.zeros((len(reader), len(METRICS)), np.float32)
        for start in range(0, len(reader), step):
            table[start : start + step] = row_metrics(reader.rows(start, start + step), frames, friction, each)
            report(min(start + step, len(reader)))
    return dict(zip(METRICS, table.T, strict=True))


def row_metrics(
    rows: GraspRows, frames: Sequence[tuple[np.ndarray, float]], friction: float, each: _Map = map
) -> np.ndarray:
    """The columns of ``METRICS`` for some rows, shape [n, 2]; of several objects in a row the least.

    Args:
        frames: What :func:`mass_frame` says of each of the shard's objects, sorted by id.
        each: ``map``, or another that works on several items at once and yields in order.
    """
    tasks = []  # rows of one object each
    for o, present in enumerate(rows.object_index.T):
        for i, (center, radius) in enumerate(frames):
            chosen = np.flatnonzero(present == i)
            for part in (chosen[at : at + TASK_ROWS] for at in range(0, len(chosen), TASK_ROWS)):
                contacts = rows.contact_points[part, o], -rows.contact_normals[part, o]
                tasks.append((part, *contacts, center, radius, friction))
    table = np.full((len(rows), len(METRICS)), np.inf)
    if tasks:
        parts, *arguments = zip(*tasks, strict=True)
        for part, values in zip(parts, each(wrench_spaces, *arguments), strict=True):
            table[part] = np.minimum(table[part], values)
    return table


def mass_frame(record: ObjectRecord) -> tuple[np.ndarray, float]:
    """Centre of mass [m], shape [3], and the largest distance of the surface from there [m].

    Raises:
        ObjectError: a flat object.
    """
    vertices = np.asarray(record.vertices, float)
    center = mass_properties(vertices, record.faces).center
    return center, float(np.linalg.norm(vertices - center, axis=1).max())


def measured_in(target: Path, source: Path) -> dict[str, str] | None:
    """The numbers (JSON) with which a complete copy of a shard was measured, by what was added; None: there is none.

    Raises:
        OutputError: Something else is in its place.
    """
    if not os.path.lexists(target) or validate_shard(target):
        return None
    with ShardReader(source) as old, ShardReader(target) as new:
        mine, theirs = ({**reader.attributes, "text_sha256": ""} for reader in (old, new))
        if (
            mine.keys() != theirs.keys()
            or not all(np.array_equal(mine[name], theirs[name]) for name in mine)  # some may be arrays
            or not all(
                np.array_equal(old.column(name), new.column(name), equal_nan=name != "candidate") for name in _ROW
            )
        ):
            raise OutputError(f"{target} holds other rows than {source}; choose another --out, or --overwrite")
        return measured_with(new)


def measured_with(reader: ShardReader) -> dict[str, str]:
    """The numbers (JSON) with which a shard was measured, by what was added."""
    told = reader.statistics.items()
    return {name.removesuffix(MEASURED): str(text) for name, text in told if name.endswith(MEASURED)}


@contextmanager
def process_map(workers: int) -> Iterator[_Map]:
    """A map over processes, or the plain one for a single worker."""
    if workers == 1:
        yield map
        return
    with ProcessPool(workers) as pool:
        yield pool.map
