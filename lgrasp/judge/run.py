"""Judges shards: files, folders of them, all of their rows or some."""

import math
import re
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from lgrasp.judge.bounds import JudgeError
from lgrasp.judge.checks import CHECKS, VALUES, RowChecks
from lgrasp.judge.duplicates import count_repeats
from lgrasp.judge.files import existing, find_shards, real
from lgrasp.judge.report import Report, ShardVerdict
from lgrasp.judge.shard import JudgedShard, not_judged, read_shard

T = TypeVar("T")
BLOCK = 64
EPSILON_ROWS = 128
"""Ferrari-Canny is recomputed for this many rows of a shard that stores it."""


def judge(
    shards: Any,
    *,
    urdf: str | Path | None = None,
    mesh: str | Path | Mapping[str, str | Path] | None = None,
    rows: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Report:
    """Judge every row of grasp shards by the strict bounds.

    Args:
        shards: shard files of format 1, or folders that hold some at any depth; or what writes one file by ``save``.
        urdf: original URDF in place of the stored one; its meshes are looked up beside it.
        mesh: original object mesh in place of the stored one (times the stored scale), or meshes by object id.
        rows: judge only this many rows, drawn at random with a fixed seed; duplicates and poses are of all rows.

    Files in folders that cannot be judged are left out; the report names them, and is not passed.

    Raises:
        JudgeError: nothing to judge, or a file that was named and cannot be judged.
    """
    if hasattr(shards, "save"):
        with tempfile.TemporaryDirectory() as folder:
            shards.save(path := Path(folder) / "grasps.h5")
            return judge(path, urdf=urdf, mesh=mesh, rows=rows, progress=progress)
    given = [shards] if isinstance(shards, str | Path) else list(shards)
    paths, named, left_out = find_shards(given), {real(path) for path in given}, list[str]()
    if rows is not None and rows < 1:
        raise JudgeError(f"rows {rows}: at least 1")
    meshes = {} if mesh is None else mesh if isinstance(mesh, Mapping) else {"": mesh}
    start = time.perf_counter()
    sources = {k: existing(p) for k, p in meshes.items()}
    original = None if urdf is None else existing(urdf)

    def sound(path: Path, make: Callable[[], T]) -> list[T]:
        """What is made of a file; nothing where it was found in a folder and cannot be judged."""
        try:
            return [make()]
        except JudgeError as error:
            if real(path) in named:
                raise
            left_out.append(str(error))
            return []

    read = [shard for p in paths for shard in sound(p, partial(read_shard, p, original, sources))]
    if not read:
        raise JudgeError(left_out[0])
    known = {name for s in read for name in s.object_ids}
    if unknown := [name for name in sources if name and name not in known]:
        raise JudgeError(f"mesh of object '{unknown[0]}': the shards hold {', '.join(sorted(known))}")
    counts = [len(s.kept_invalid) for s in read]
    total = sum(counts)
    if not total:
        raise JudgeError("; ".join([f"no row in {', '.join(str(s.path) for s in read[:3])}", *left_out[:1]]))
    chosen = np.arange(total)
    if rows is not None and rows < total:
        chosen = np.sort(np.random.default_rng(0).choice(total, rows, replace=False))
    loaded = time.perf_counter()
    verdicts, done = [], 0
    for s, first in zip(read, np.cumsum([0, *counts]), strict=False):
        mine = chosen[(chosen >= first) & (chosen < first + len(s.kept_invalid))] - first
        step = partial(_step, progress, done, len(chosen))
        verdicts += sound(s.path, partial(_judge_shard, s, mine, step))
        done += len(mine)
    if not verdicts:
        raise JudgeError(left_out[0])
    judged = {verdict.path for verdict in verdicts}
    repeats = count_repeats([s for s in read if s.path in judged])
    return Report(verdicts, repeats, time.perf_counter() - loaded, loaded - start, left_out)


def _step(progress: Callable[[int, int], None] | None, before: int, total: int, done: int) -> None:
    if progress:
        progress(before + done, total)


def _judge_shard(shard: JudgedShard, rows: np.ndarray, step: Callable[[int], object]) -> ShardVerdict:
    """All checks on chosen rows, a block at a time."""
    stored = any("epsilon" in name.lower() for name in shard.metrics)
    blocks = []
    for first in range(0, len(rows), BLOCK):
        step(first)
        some, epsilon = rows[first : first + BLOCK], stored and first < EPSILON_ROWS
        try:
            blocks.append(RowChecks(shard, some, epsilon=epsilon))
        except (ValueError, ArithmeticError, LookupError, TypeError) as error:  # of numbers that no check expects
            raise not_judged(shard.path, error) from error
    values = {k: np.concatenate([np.zeros(0), *(b.values[k] for b in blocks)]) for k in VALUES}
    return ShardVerdict(
        total_rows=len(shard.kept_invalid),
        kept_invalid=shard.kept_invalid[rows],
        values=values,
        failed={k: np.concatenate([np.zeros(0, bool), *(b.failed[k] for b in blocks)]) for k in CHECKS},
        held=(np.asarray(shard.grasps["object_index"])[rows] >= 0).sum(axis=1),
        metrics=metric_errors(shard, rows, values),
        self_pairs=sum((b.self_pairs for b in blocks), Counter()),
        notes=shard.notes,
        path=shard.path,
        rows=rows,
        claims=shard.claims,
    )


METRICS = {
    "epsilon(_exact)?": "epsilon",
    "fswo|(residual_)?frictionless": "residual_frictionless",
    "gswo|residual": "residual",
    "self_penetration": "self_penetration_mm",
    "object_object_penetration|penetration_between_objects": "object_object_mm",
    "(max_)?penetration(_depth)?": "penetration_mm",
    "(contact_)?gap": "contact_link_mm",
    "normals?(_(error|angle))?": "normal_deg",
    "links(_in_contact)?|contact_links": "links_in_contact",
    "contacts|contact_count|num_contacts": "contacts",
}
"""Names of stored metrics, and the number that each is compared with."""


def metric_errors(shard: JudgedShard, rows: np.ndarray, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Absolute deviation (n,) of stored metrics from recomputed values; metrics are recognised by name and unit."""
    out = {}
    for name, (data, unit) in shard.metrics.items():
        stored, given = np.asarray(data, float)[rows], unit.strip().lower()
        value = next((value for form, value in METRICS.items() if re.fullmatch(form, name.lower())), None)
        if value is None:
            continue
        if value == "normal_deg":
            name, stored = f"{name} [deg]", stored * (1.0 if given.startswith("deg") else math.degrees(1.0))
        elif value.endswith("_mm"):
            size = np.abs(stored) if value == "contact_link_mm" else np.maximum(stored, 0.0)
            name, stored = f"{name} [mm]", size * (1.0 if given == "mm" else 1e3)
        out[name] = np.abs(stored - values[value])
        if value == "residual":
            out[f"{name} (stored normals)"] = np.abs(stored - values["residual_stored_normals"])
    return out
