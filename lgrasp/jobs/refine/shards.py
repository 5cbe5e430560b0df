"""The job of ``lgrasp refine``: shards, or grasps of other formats, moved by a local search and written again."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from lgrasp.dataset import GraspRows, ShardHeader, read_shard, write_shard
from lgrasp.dataset.checks import row_problems
from lgrasp.dataset.files import remove_leftovers
from lgrasp.dataset.tree import shard_tree
from lgrasp.engine.cache import Cache
from lgrasp.engine.folder import check_folder, shard_path
from lgrasp.errors import ConfigError, HandError, OutputError, ShardError
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.records import Shard
from lgrasp.hand.arrays import HandArrays, upload_hand
from lgrasp.jobs.refine.moved import Moved, move_rows
from lgrasp.jobs.refine.sources import grasp_shards
from lgrasp.jobs.shard_inputs import hand_of_shard, named_hand, object_of_shard
from lgrasp.runtime.device import Device, resolve_device
from lgrasp.stages.refine.params import RefineParams


@dataclass(frozen=True)
class Refinement:
    """What is refined and where it goes."""

    sources: Sequence[Path]  # shards, folders of them at any depth; or one export, see ``form``
    out: Path
    form: str | None = None  # format of another program; none: shards
    hand: str | None = None  # of grasps in another format; shards hold their own
    always: bool = False  # every row takes its refined posture, whatever the checks say
    params: RefineParams = field(default_factory=RefineParams)
    bounds: GraspBounds = field(default_factory=GraspBounds)
    device: str = "auto"
    force: bool = False
    cache: Cache = field(default_factory=Cache)


@dataclass(frozen=True)
class RefinedShard:
    """One file that was written."""

    path: Path
    hand: str
    object: str
    moved: Moved
    seconds: float


def refine_shards(job: Refinement, progress: Callable[[Path, int, int], None] | None = None) -> list[RefinedShard]:
    """Refine the rows of shards; each shard is written under its place in the output folder. One without rows is left
    out.

    Args:
        progress: called with (shard, its rows, rows done); what it raises ends the job, whole shards stay.

    Raises:
        ShardError: a source cannot be read, holds rows of several objects or that are not finite; no rows at all.
        HandError: the hand is unknown, or another than the one of the shard.
        OutputError: a file would be overwritten, or the folder cannot be written.
    """
    device = resolve_device(job.device)
    hands: dict[str, HandArrays] = {}
    check_folder(job.out)
    remove_leftovers(job.out, "*.h5.tmp")
    done = []
    for source, target, shard in _shards(job, hands, device):
        if not len(shard.grasps):
            job.cache.warn(f"{source} holds no grasps; it is left out")
            continue
        _check_rows(source, shard)
        hand = _hand(job, source, shard, hands, device)
        model = object_of_shard(job.cache, shard.objects[0], device)
        begin = time.perf_counter()
        moved = move_rows(
            hand,
            model,
            shard.grasps,
            job.params,
            job.bounds,
            always=job.always,
            stored=job.form is None,
            progress=partial(progress, target, len(shard.grasps)) if progress else None,
        )
        seconds = time.perf_counter() - begin
        write_shard(target, _written(shard, moved.rows, job, seconds))
        done.append(RefinedShard(target, shard.hand.name, shard.objects[0].name, moved, seconds))
    if not done:
        raise ShardError(f"{', '.join(map(str, job.sources))}: no grasps to refine")
    return done


def _shards(job: Refinement, hands: dict[str, HandArrays], device: Device) -> Iterator[tuple[Path, Path, Shard]]:
    """Where each shard to refine comes from, the file to write, and the shard."""
    if job.form is None:
        found = shard_tree(job.sources)
        for place in found:
            _check_free(job, job.out / place)
        for place, path in found.items():
            yield path, job.out / place, read_shard(path)
        return
    if len(job.sources) != 1 or job.hand is None:
        raise ConfigError(f"grasps in format {job.form}: give one folder or file, and their hand with --hand")
    source, model = named_hand(job.cache, job.hand, device)
    hands[model.sha256] = upload_hand(model, device.alias)
    for shard in grasp_shards(job.sources[0], job.form, source, model):
        target = shard_path(job.out, model.name, shard.objects[0].id, 0)
        _check_free(job, target)
        yield job.sources[0], target, shard


def _check_free(job: Refinement, target: Path) -> None:
    if target.exists() and not job.force:
        raise OutputError(f"{target} exists; choose another folder with --out, or --force to replace it")


def _check_rows(path: Path, shard: Shard) -> None:
    """Refuse what cannot be repaired; joints outside their limits can."""
    rows, hand = shard.grasps, shard.hand
    if rows.sequence is not None or len(shard.objects) != 1 or np.shape(rows.object_index)[1] != 1:
        raise ShardError(f"{path}: rows of several objects cannot be refined; one object to a shard is accepted")
    q = np.where(np.isfinite(rows.q), np.clip(rows.q, hand.joint_lower, hand.joint_upper), rows.q)
    columns = rows.columns()
    problems = row_problems(
        replace(rows, q=q), hand, [shard.objects[0].id], lambda name, first, end: columns[name][first:end]
    )
    if problems:
        raise ShardError(f"{path}: {problems[0]}; grasps as 'lgrasp dataset validate' accepts them can be refined")


def _hand(job: Refinement, path: Path, shard: Shard, hands: dict[str, HandArrays], device: Device) -> HandArrays:
    """The hand of a shard, whatever is installed under its name; ``--hand`` is only compared with it."""
    digest = shard.hand.sha256
    if digest not in hands:
        if job.hand is not None and (named := named_hand(job.cache, job.hand, device)[1]).sha256 != digest:
            raise HandError(
                f"{path}: its grasps are of hand '{shard.hand.name}' (hash {digest[:12]}), not of '{named.name}' (hash "
                f"{named.sha256[:12]}); leave --hand out, the hand is in the shard"
            )
        _, model = hand_of_shard(job.cache, shard.hand, shard.header.config, device)
        hands[digest] = upload_hand(model, device.alias)
    return hands[digest]


def _written(shard: Shard, rows: GraspRows, job: Refinement, seconds: float) -> Shard:
    config = {
        **shard.header.config,
        "bounds": job.bounds.describe(),
        "refine": job.params.model_dump(mode="json"),
        "refine_always": job.always,
    }
    header = ShardHeader(
        pipeline=shard.header.pipeline,
        seed=shard.header.seed,
        shard_index=shard.header.shard_index,
        config=config,
        merged_from=shard.header.merged_from,
    )
    counts = {
        "refine_tried": len(rows),
        "refine_replaced": int(rows.metrics["refined"].sum()),
        "seconds_refine": seconds,
    }
    return replace(shard, header=header, grasps=rows, statistics={**shard.statistics, **counts})
