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
from lgrasp.decompose import decompose
from lgrasp.device.runtime import resolve_device
from lgrasp.engine.cache import Cache
from lgrasp.engine.folder import check_folder
from lgrasp.errors import ConfigError, OutputError, ShardError
from lgrasp.physics import Protocol, Scene, protocol_text, scene_of_shard, verdicts
from lgrasp.physics.model import import_mujoco

__all__ = ["Validated", "Validation", "summary", "validate_shards"]

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
    object: str
    columns: dict[str, np.ndarray]  # of the protocol, without its name
    seconds: float  # 0: the shard was there already
    mass: float  # [kg]
    stiffness: float  # [N m/rad]
    pieces: int  # convex pieces of the object
    notes: tuple[str, ...]


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
        preparing: called with a shard before its hand and object are cut into convex pieces.

    Raises:
        ShardError: a shard cannot be read, or holds several objects.
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
    prefix, load = f"{protocol.name}_", protocol.load(scene.object.volume)
    return Validated(
        path=path,
        hand=shard.hand.name,
        object=scene.object.name,
        columns={n.removeprefix(prefix): v for n, v in shard.grasps.physics.items() if n.startswith(prefix)},
        seconds=seconds,
        mass=load.mass,
        stiffness=load.stiffness,
        pieces=len(scene.object.pieces),
        notes=scene.object.notes,
    )


def summary(done: Sequence[Validated], protocol: Protocol) -> list[dict[str, Any]]:
    """One entry per hand and object: shares of grasps that hold, contacts, load and speed."""
    groups: dict[tuple[str, str], list[Validated]] = {}
    for entry in done:
        groups.setdefault((entry.hand, entry.object), []).append(entry)
    return [_entry(group, protocol) for group in groups.values()]


def _entry(group: list[Validated], protocol: Protocol) -> dict[str, Any]:
    columns = {n: np.concatenate([one.columns[n] for one in group]) for n in group[0].columns}
    rows, simulated = len(columns["holds"]), sum(len(one.columns["holds"]) for one in group if one.seconds)
    seconds = sum(one.seconds for one in group)
    run = columns["directions"] >= 0
    return {
        "hand": group[0].hand,
        "object": group[0].object,
        "rows": rows,
        "held": int(columns["holds"].sum()),
        "directions_held": (columns["directions"] == 1).sum(0).tolist(),
        "directions_run": run.sum(0).tolist(),
        "contact_at_q": int((columns["contact_at_q"] >= _CONTACTS).sum()),
        "contact_at_grasp": int((columns["contact_at_grasp"] >= _CONTACTS).sum()),
        "pregrasp_too_deep": int((columns["pregrasp_penetration"] > protocol.most_penetration).sum()),
        "diverged": int(columns["diverged"].sum()),
        "mass": group[0].mass,
        "friction": protocol.friction,
        "stiffness": group[0].stiffness,
        "pieces": group[0].pieces,
        "notes": list(group[0].notes),
        "seconds": seconds,
        "per_s": simulated / seconds if seconds else None,
        "shards": [str(one.path) for one in group],
    }
