"""What a job would compute, found out without computing or writing anything."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from lgrasp.engine.bank import BANK_CANDIDATES, Bank
from lgrasp.engine.folder import check_folder, shard_path
from lgrasp.engine.inputs import input_keys, run_key
from lgrasp.jobs.generate import Job, find_present, job_shards
from lgrasp.jobs.hands import hand_source
from lgrasp.runtime.device import resolve_device


class PlanLine(NamedTuple):
    """One artifact of a job."""

    what: str  # hand, object, field, bank, shard
    which: str
    state: str  # hit, miss, present, missing
    todo: str
    file: str


def plan(job: Job) -> list[PlanLine]:
    """The artifacts of a job in the order in which it would make them.

    Raises:
        LgraspError: bad input, as :func:`generate` would raise it before computing.
    """
    shards = job_shards(job)
    with _no_kernel_folder():
        resolve_device(job.device)
    pipeline = job.pipeline
    keys = input_keys(hand_source(job.hand), job.object, job.scale, pipeline.object, pipeline.field)
    assert keys.mesh is not None
    check_folder(job.out)
    key = run_key(pipeline.describe(), keys, job.shard_rows)
    lines = [
        _cached(job, "hand", keys.source.name, keys.hand, "build"),
        _cached(job, "object", keys.mesh.stem, keys.object, "preprocess"),
        _cached(job, "field", keys.source.name, keys.field, f"build ({pipeline.field.index})"),
    ]
    files = {s: shard_path(job.out, keys.source.name, keys.mesh.stem, s) for s, _ in shards}
    present = find_present(job, files, key)
    for shard, rows in shards:
        path = files[shard]
        if shard in present:
            found = present[shard]
            lines.append(PlanLine("shard", str(shard), "present", f"nothing, {found:,} rows are there", str(path)))
            continue
        if job.reuse:
            lines.append(_banks(job, Bank(job.cache, pipeline, keys, shard, "cpu")))
        what = f"{rows:,} rows" + (", replacing the file" if path.exists() else "")
        lines.append(PlanLine("shard", str(shard), "missing", what, str(path)))
    return lines


def _cached(job: Job, kind: str, name: str, key: str, verb: str) -> PlanLine:
    hit = job.cache.has(kind, key)
    return PlanLine(kind, name, "hit" if hit else "miss", "load" if hit else verb, str(job.cache.path(kind, key)))


def _banks(job: Job, bank: Bank) -> PlanLine:
    count = 0
    while bank.has(count * BANK_CANDIDATES, BANK_CANDIDATES):
        count += 1
    todo = f"use {count} x {BANK_CANDIDATES} candidates, make more as needed" if count else "make as needed"
    return PlanLine("bank", str(bank.shard), "hit" if count else "miss", todo, str(job.cache.root / "bank"))


@contextmanager
def _no_kernel_folder() -> Iterator[None]:
    """Starting Warp makes its folder for compiled kernels; let that be a temporary one."""
    if "WARP_CACHE_PATH" in os.environ:
        yield
        return
    with tempfile.TemporaryDirectory() as folder:
        os.environ["WARP_CACHE_PATH"] = folder
        try:
            yield
        finally:
            del os.environ["WARP_CACHE_PATH"]
