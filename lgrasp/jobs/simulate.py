"""Physics verdicts of shards: every shard is read, simulated and written again with the verdicts beside its rows."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, PrivateAttr, field_validator

from lgrasp.dataset import Shard, read_shard
from lgrasp.engine.cache import content_key
from lgrasp.engine.events import Made, Part, PartProgress
from lgrasp.engine.run import JobOutcome
from lgrasp.engine.shard_job import ShardJob
from lgrasp.errors import ConfigError
from lgrasp.geometry.decompose import decompose
from lgrasp.simulate.builder import import_mujoco
from lgrasp.simulate.columns import COLUMNS, OBJECT_COLUMNS
from lgrasp.simulate.protocol import Protocol, find_protocol
from lgrasp.simulate.run import protocol_text, verdicts
from lgrasp.simulate.scene import Scene, scene_of_shard
from lgrasp.simulate.solid import Solid

_CONTACTS = 2  # links that it takes to hold anything


class SimulateJob(ShardJob):
    """Verdicts of a physics simulation beside the rows of shards."""

    protocol: Protocol = Field(description="Named protocol.")
    out: Path | None = Field(None, description="Folder; default: that of the shards with -PROTOCOL added.")
    device: str = "cpu"
    all_directions: bool = Field(False, description="Go on after the first direction in which an object is lost.")
    _said: set[str] = PrivateAttr(default_factory=set)
    _scene: tuple[tuple[str, ...], Scene] | None = PrivateAttr(None)  # the latest

    @field_validator("protocol", mode="before")
    @classmethod
    def _named(cls, value: object) -> object:
        return find_protocol(value) if isinstance(value, str) else value

    @property
    def folder(self) -> Path:
        if self.out is not None:
            return self.out
        folders = {(path if path.is_dir() else path.parent).absolute() for path in self.shards}
        if len(folders) > 1:
            raise ConfigError(f"the shards lie in {len(folders)} folders; name one for the results with --out")
        parent = folders.pop()
        return parent.with_name(f"{parent.name}-{self.protocol.name}")

    def key(self) -> str:
        described = self.protocol.model_dump(mode="json")
        return content_key("simulate", 1, protocol=described, all_directions=self.all_directions, device=self._kind())

    def parts(self) -> list[Part]:
        import_mujoco()
        return super().parts()

    def make(self, part: Part, progress: PartProgress) -> Made:
        assert part.source is not None
        shard = read_shard(part.source)
        scene = self._scene_of(shard)
        device = self.device_used.alias
        text = protocol_text(scene, self.protocol, all_directions=self.all_directions, device=device)
        begin = time.perf_counter()
        found = verdicts(
            scene,
            shard.grasps,
            self.protocol,
            threads=self.workers or os.cpu_count() or 1,
            progress=lambda done, held: progress(
                done, f"{held:,} hold  {done / max(time.perf_counter() - begin, 1e-9):.1f}/s"
            ),
            all_directions=self.all_directions,
            device=device,
        )
        seconds = time.perf_counter() - begin
        shard = _with_verdicts(shard, self.protocol, found, text, seconds)
        return Made(len(shard.grasps), self.marked(part, shard, {}), seconds)

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        """``protocol``; ``results``: see :func:`summary`; ``notes`` on objects that are approximated."""
        seconds = {part.file: made.result for part, made in outcome.made_parts}
        done = []
        for path in outcome.paths:
            shard = read_shard(path)
            done.append(_validated(path, shard, self._scene_of(shard), self.protocol, seconds.get(path, 0.0)))
        return {"protocol": self.protocol.model_dump(mode="json"), "results": summary(done, self.protocol)}

    def _kind(self) -> str:
        return "gpu" if self.device_used.is_cuda else "cpu"

    def _scene_of(self, shard: Shard) -> Scene:
        """What is simulated of a shard: hand and objects cut into convex pieces."""
        key = (shard.hand.sha256, *(f"{record.sha256} {record.scale}" for record in shard.objects))
        if self._scene is None or self._scene[0] != key:
            scene = scene_of_shard(shard, partial(decompose, store=self.cache), self.device_used.alias)
            for line in (f"object {solid.name}: {note}" for solid in scene.objects for note in solid.notes):
                if line not in self._said:
                    self._said.add(line)
                    self.cache.warn(line)
            self._scene = key, scene
        return self._scene[1]


@dataclass(frozen=True)
class Validated:
    """One shard with its verdicts."""

    path: Path
    hand: str
    objects: tuple[Solid, ...]  # sorted by their ids
    object_index: np.ndarray  # (N, O) position in them, -1 absent
    columns: dict[str, np.ndarray]  # of the protocol, without its name
    seconds: float  # 0: the shard was there already


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
