"""The plan of a job, without computing or writing anything."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from lgrasp.engine.run import Job, look
from lgrasp.files import temporary_folder
from lgrasp.jobs.generate import GenerateJob
from lgrasp.runtime.array import Array
from lgrasp.words import plural


class PlanLine(NamedTuple):
    """One artifact of a job."""

    what: str  # hand, object, field, bank, shard
    which: str
    state: str  # hit, miss, present, missing
    todo: str
    file: str


def preview(job: Job, *, array: Array | tuple[int, int], resume: bool) -> list[PlanLine]:
    """The artifacts of a job in the order in which it would make them.

    Raises:
        LgraspError: bad input, as :func:`lgrasp.engine.run.run` would raise it before computing.
    """
    with _no_kernel_folder():
        _, _, _, parts, present = look(job, array=array, resume=resume and not job.late_key)
    lines = _inputs(job) if isinstance(job, GenerateJob) else []
    for part in parts:
        number, file = str(part.number), str(part.file)
        if part.number in present:
            lines.append(
                PlanLine("shard", number, "present", f"nothing, {present[part.number]:,} rows are there", file)
            )
            continue
        if job.late_key and resume and part.file.exists():
            lines.append(PlanLine("shard", number, "present", "nothing, if it is of the same grasps", file))
            continue
        what = plural(part.rows, job.unit[:-1]) + (", replacing the file" if part.file.exists() else "")
        lines.append(PlanLine("shard", number, "missing", what, file))
    return lines


def _inputs(job: GenerateJob) -> list[PlanLine]:
    keys = job.keys
    assert keys.mesh is not None
    return [
        _cached(job, "hand", keys.source.name, keys.hand, "build"),
        _cached(job, "object", keys.mesh.stem, keys.object, "preprocess"),
        _cached(job, "field", keys.source.name, keys.field, f"build ({job.pipeline.field.index})"),
    ]


def _cached(job: GenerateJob, kind: str, name: str, key: str, verb: str) -> PlanLine:
    hit = job.cache.has(kind, key)
    return PlanLine(kind, name, "hit" if hit else "miss", "load" if hit else verb, str(job.cache.path(kind, key)))


@contextmanager
def _no_kernel_folder() -> Iterator[None]:
    """Starting Warp makes its folder for compiled kernels; let that be a temporary one."""
    if "WARP_CACHE_PATH" in os.environ:
        yield
        return
    with temporary_folder() as folder:
        os.environ["WARP_CACHE_PATH"] = str(folder)
        try:
            yield
        finally:
            del os.environ["WARP_CACHE_PATH"]
