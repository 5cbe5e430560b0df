"""Physics verdicts of shards: every shard is read, simulated and written again with the verdicts beside its rows."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.dataset import GraspRows, Shard, find_shards, read_shard, write_shard
from lgrasp.dataset.files import remove_leftovers
from lgrasp.engine.cache import Cache
from lgrasp.engine.folder import check_folder
from lgrasp.errors import ConfigError, OutputError, ShardError
from lgrasp.geometry.decompose import decompose
from lgrasp.runtime.device import resolve_device
from lgrasp.simulate.builder import import_mujoco
from lgrasp.simulate.columns import COLUMNS, OBJECT_COLUMNS
from lgrasp.simulate.protocol import Protocol
from lgrasp.simulate.run import protocol_text, verdicts
from lgrasp.simulate.scene import Scene, scene_of_shard
from lgrasp.simulate.solid import Solid

_CONTACTS = 2  # links that it takes to hold anything


@dataclass(frozen=True)
class Validation:
    """What is simulated and where it goes."""

    shards: Sequence[Path]  # files, or folders of *.h5 files
    protocol: Protocol
    out: Path | None = None  # folder; none: that of the shards with -PROTOCOL added
    threads: int = 0  # 0: all cores
    device: str = "cpu"
    all_directions: bool = False
    resume: bool = True
    cache: Cache = field(default_factory=Cache)


@dataclass(frozen=True)
class Validated:
    """One shard with its verdicts."""

    path: Path
    hand: str
    objects: tuple[Solid, ...]  # sorted by their ids
    object_index: np.ndarray  # (N, O) position in them, -1 absent
    columns: dict[str, np.ndarray]  # of the protocol, without its name
    seconds: float  # 0: the shard was there already


def validate_shards(
    job: Validation,
    started: Callable[[Path, int], None] | None = None,
    progress: Callable[[int, int], None] | None = None,
    preparing: Callable[[Path], None] | None = None,
) -> list[Validated]:
    """Simulate the rows of shards; what is done already in the output folder stays.

    Args:
        started: called with (shard, rows) before its simulation.
        progress: called with (rows done, rows held); what it raises ends the job, whole shards stay.
        preparing: called with a shard before its hand and objects are cut into convex pieces.

    Raises:
        ShardError: a shard cannot be read.
        OutputError: the output cannot be written, or holds other shards.
        PhysicsError: MuJoCo is missing or refuses a hand.
    """
    import_mujoco()
    device = resolve_device(job.device).alias
    sources = find_shards(job.shards)
    targets = _targets(sources, job)
    cut = partial(decompose, store=job.cache)
    scenes: dict[tuple[str, ...], Scene] = {}
    done = []
    for source, target in targets.items():
        shard = read_shard(source)
        key = (shard.hand.sha256, *(record.sha256 for record in shard.objects), *(str(o.scale) for o in shard.objects))
        if key not in scenes:
            if preparing:
                preparing(source)
            scenes = {key: scene_of_shard(shard, cut, device)}
        scene = scenes[key]
        text = protocol_text(scene, job.protocol, all_directions=job.all_directions, device=device)
        seconds = 0.0
        if not (job.resume and _is_done(target, shard.grasps, job.protocol, text, job.cache.warn)):
            if started:
                started(source, len(shard.grasps))
            begin = time.perf_counter()
            found = verdicts(
                scene,
                shard.grasps,
                job.protocol,
                threads=job.threads or os.cpu_count() or 1,
                progress=progress,
                all_directions=job.all_directions,
                device=device,
            )
            seconds = time.perf_counter() - begin
            shard = _with_verdicts(shard, job.protocol, found, text, seconds)
            write_shard(target, shard)
        else:
            shard = read_shard(target)
        done.append(_validated(target, shard, scene, job.protocol, seconds))
    return done


def _targets(sources: list[Path], job: Validation) -> dict[Path, Path]:
    """Source -> file to write.

    Raises:
        ConfigError: no folder follows from the sources.
        OutputError: the folder is not writable, or two files would get one name.
    """
    folders = {path.parent for path in sources}
    if job.out is None and len(folders) > 1:
        raise ConfigError(f"the shards lie in {len(folders)} folders; name one for the results with --out")
    parent = folders.pop()
    out = job.out or parent.absolute().with_name(f"{parent.absolute().name}-{job.protocol.name}")
    targets = {path: out / path.name for path in sources}
    if len(set(targets.values())) < len(sources):
        raise OutputError(f"two of the shards have the same name and cannot both go to {out}")
    for source, target in targets.items():
        if target.exists() and target.samefile(source):
            raise OutputError(f"{source} would be overwritten; choose another folder with --out")
    check_folder(out)
    remove_leftovers(out, "*.h5.tmp")
    return targets


def _is_done(target: Path, rows: GraspRows, protocol: Protocol, text: str, warn: Callable[[str], None]) -> bool:
    """Does a file hold these rows with verdicts of this protocol?

    Raises:
        OutputError: it holds something else.
    """
    if not target.exists():
        return False
    try:
        found = read_shard(target).grasps
    except ShardError as error:
        warn(f"{error}; it is made anew")
        return False
    same = found.physics_protocols.get(f"{protocol.name}_holds") == text and all(
        np.array_equal(getattr(found, name), getattr(rows, name), equal_nan=True)
        for name in ("q", "q_pregrasp", "q_squeeze", "object_pose")
    )
    if not same:
        raise OutputError(
            f"{target} holds other grasps or another protocol; choose another --out, or --no-resume to replace it"
        )
    return True


def _with_verdicts(
    shard: Shard, protocol: Protocol, columns: dict[str, np.ndarray], text: str, seconds: float
) -> Shard:
    rows = replace(
        shard.grasps,
        physics={**shard.grasps.physics, **columns},
        physics_protocols={**shard.grasps.physics_protocols, **dict.fromkeys(columns, text)},
    )
    name = protocol.name
    counts = {
        f"{name}_tried": len(rows),
        f"{name}_held": int(columns[f"{name}_holds"].sum()),
        f"seconds_{name}": seconds,
    }
    return replace(shard, grasps=rows, statistics={**shard.statistics, **counts})


def _validated(path: Path, shard: Shard, scene: Scene, protocol: Protocol, seconds: float) -> Validated:
    prefix = f"{protocol.name}_"
    columns = {n: shard.grasps.physics.get(prefix + n) for n in COLUMNS | OBJECT_COLUMNS}
    return Validated(
        path=path,
        hand=shard.hand.name,
        objects=scene.objects,
        object_index=np.asarray(shard.grasps.object_index),
        columns={n: values for n, values in columns.items() if values is not None},
        seconds=seconds,
    )


def summary(done: Sequence[Validated], protocol: Protocol) -> list[dict[str, Any]]:
    """One entry per hand and objects of a grasp, in the order of its slots: shares that hold, contacts, load, speed."""
    groups: dict[tuple[str, tuple[str, ...]], list[Validated]] = {}
    for one in done:
        sets, which = np.unique(one.object_index, axis=0, return_inverse=True)
        for number in np.lexsort([*sets.T[::-1], (sets >= 0).sum(1)]):
            part = _part(one, which.ravel() == number)
            groups.setdefault((one.hand, tuple(solid.name for solid in part.objects)), []).append(part)
    return [_entry(group, protocol) for group in groups.values()]


def _part(one: Validated, chosen: np.ndarray) -> Validated:
    """The chosen rows (N,), which have the same objects in the same order, and these objects alone."""
    index = one.object_index[chosen]
    return replace(
        one,
        objects=tuple(one.objects[k] for k in index[0] if k >= 0),
        object_index=index,
        columns={name: values[chosen] for name, values in one.columns.items()},
        seconds=one.seconds * chosen.mean(),
    )


def _entry(group: list[Validated], protocol: Protocol) -> dict[str, Any]:
    columns = {n: np.concatenate([one.columns[n] for one in group]) for n in group[0].columns if "object_" not in n}
    rows, simulated = len(columns["holds"]), sum(len(one.columns["holds"]) for one in group if one.seconds)
    seconds = float(sum(one.seconds for one in group))
    run = columns["directions"] >= 0
    solids = group[0].objects
    loads = [protocol.load(solid.volume) for solid in solids]
    return {
        "hand": group[0].hand,
        "object": "+".join(solid.name for solid in solids),
        "objects": [solid.name for solid in solids],
        "rows": rows,
        "held": int(columns["holds"].sum()),
        "stay": int(columns["stays"].sum()) if "stays" in columns else None,
        "penetration": float(np.median(columns["penetration"])) if "penetration" in columns else None,
        "directions_held": (columns["directions"] == 1).sum(0).tolist(),
        "directions_run": run.sum(0).tolist(),
        "contact_at_q": int((columns["contact_at_q"] >= _CONTACTS).sum()),
        "contact_at_grasp": int((columns["contact_at_grasp"] >= _CONTACTS).sum()),
        "pregrasp_too_deep": int((columns["pregrasp_penetration"] > protocol.most_penetration).sum()),
        "diverged": int(columns["diverged"].sum()),
        "mass": sum(load.mass for load in loads),
        "friction": protocol.friction,
        "stiffness": max(load.stiffness for load in loads),
        "pieces": sum(len(solid.pieces) for solid in solids),
        "notes": [f"object {solid.name}: {note}" for solid in solids for note in solid.notes],
        "seconds": seconds,
        "per_s": simulated / seconds if seconds else None,
        "shards": [str(one.path) for one in group],
    }
