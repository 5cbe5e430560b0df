"""Simulates the rows of shards and adds the verdicts to them, or to copies."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from lgrasp.dataset.checks import refuse_problems
from lgrasp.dataset.reader import ShardReader, count_rows
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import JobOutcome, Made, Part, PartProgress
from lgrasp.engine.shard_job import rows_digest
from lgrasp.errors import PhysicsError, ShardError
from lgrasp.grasp.records import HandRecord, ObjectRecord
from lgrasp.jobs.records import cutter
from lgrasp.jobs.requests.shards import SimulateRequest
from lgrasp.jobs.shard_inputs import mesh_hash
from lgrasp.jobs.verdicts import VerdictJob
from lgrasp.runtime.cores import threads
from lgrasp.runtime.device import resolve_device
from lgrasp.runtime.kept import Keeper
from lgrasp.simulate.engines import SOLVERS
from lgrasp.simulate.lift import check_liftable
from lgrasp.simulate.protocol import NO_TABLE, Protocol
from lgrasp.simulate.run import (
    VERDICT_VERSION,
    check_installed,
    load_world_kernels,
    on_cpu,
    protocol_text,
    verdicts,
)
from lgrasp.simulate.scene import Scene, scene_of
from lgrasp.simulate.solid import Solid
from lgrasp.simulate.verdict import COLUMNS, DRAWN_COLUMNS, LIFT_COLUMNS, OBJECT_COLUMNS

_MIN_HOLDING_LINKS = 2  # links that it takes to hold anything
_GPU_BLOCK = 8192  # rows of a block on a GPU, which simulates so many side by side
_BLOCK_SECONDS = 15.0  # that a block of rows should take
_FIRST = 8  # rows of the first block, for each thread
_KIND, _SECONDS = "verdicts", "about"  # of the entries in the cache; member with the seconds


class SimulateJob(SimulateRequest, VerdictJob):
    """Adds verdicts of a physics simulation to shards, in place or to copies."""

    command: ClassVar[str] = "simulate"
    version: ClassVar[int] = VERDICT_VERSION

    _said: set[str] = PrivateAttr(default_factory=set)
    _kept: Keeper = PrivateAttr(default_factory=Keeper)

    @property
    def verdict(self) -> tuple[str, str]:
        return self.protocol.name, f"{self.protocol.name}_holds"

    def settings(self) -> dict[str, Any]:
        described = self.protocol.model_dump(mode="json")
        told = {"all_directions": self._all, "device": self._kind(), "version": self.version}
        return described | SOLVERS[self.protocol.engine] | told

    @property
    def _all(self) -> bool:
        """Whether all directions are asked for, of a protocol that has some."""
        return self.all_directions and self.protocol.lift is None

    def told(self, protocol: dict[str, Any]) -> dict[str, Any]:
        device = "gpu" if str(protocol.get("simulator")).startswith("mujoco_warp") else "cpu"
        # what shards do not tell that were written before there was a choice
        older = {"engine": "mujoco", "draws": None, "lift": None, "shake": None}
        found = older | super().told(protocol) | {"device": device}
        if found["engine"] == "physx" and isinstance(solver := found.get("solver"), dict):
            found["solver"] = {"persistent_contacts": True} | solver
        # all of them are more than is asked for, if not all are
        return found | {"all_directions": bool(found.get("all_directions")) and self._all}

    def check_source(self, reader: ShardReader) -> None:
        steered = reader.header.config.get("steered")
        if self.protocol.table and isinstance(steered, dict) and "above" in steered:
            raise ShardError(f"{reader.path}: {NO_TABLE}")
        if self.protocol.lift:
            try:
                check_liftable(self.protocol, [record.tables for record in reader.objects()], reader.rows(0, 0))
            except PhysicsError as error:
                raise ShardError(f"{reader.path}: {error}") from None

    def digest(self, reader: ShardReader) -> str:
        return rows_digest(reader, ("table/pose", "table/approach") if self.protocol.table else ())

    def parts(self) -> list[Part]:
        check_installed(resolve_device(self.device).alias, self.protocol)
        return super().parts()

    def make(self, part: Part, progress: PartProgress) -> Made:
        assert part.source is not None
        protocol, device, name = self.protocol, self.device_used.alias, self.protocol.name
        workers = threads(self.workers)
        with ShardReader(part.source) as reader:
            hand, objects, rows = reader.hand(), reader.objects(), len(reader)
            ahead = None
            if self._kind() == "gpu":
                ahead = partial(load_world_kernels, hand, objects, reader.rows(0, 1), protocol, device)
            scene = self._scene_of(hand, objects, progress, ahead)
            key = self.key_of(reader)
            kept = KeptVerdicts(self.cache, key, name, largest=_GPU_BLOCK if self._kind() == "gpu" else None)

            before = kept.rows

            def told(done: int, held: int) -> None:
                note = f"{(kept.held + held) / max(kept.rows + done, 1):.0%} hold"
                progress(kept.rows + done, note, kept=before)

            while (block := kept.next_block(rows, workers)) or not kept.columns:
                some = reader.rows(kept.rows, kept.rows + block)
                refuse_problems(part.source, some, hand, objects, reader.column, "simulated", first_row=kept.rows)
                found = verdicts(
                    scene,
                    some,
                    protocol,
                    threads=workers,
                    progress=told,
                    all_directions=self._all,
                    device=device,
                    keep=self._kept.get,
                    prepared=kept.prepared,
                )
                kept.add(found, last=kept.rows + block == rows)
        added = {
            "physics": kept.columns,
            "protocol": protocol_text(scene, protocol, all_directions=self._all, device=device),
            "statistics": {
                f"{name}_tried": rows,
                f"{name}_held": kept.held,
                f"seconds_{name}": kept.seconds,
                f"seconds_{name}_compile": kept.compiling,
            },
        }
        return Made(rows, (kept, key, added), (kept.seconds, kept.compiling), before)

    def close(self) -> None:
        self._kept.close()

    def write(self, part: Part, contents: Any) -> None:
        kept, *made = contents
        super().write(part, made)
        kept.discard()

    def kept_of(self, part: Part) -> int:
        return KeptVerdicts(self.cache, self.part_key(part), self.protocol.name).rows

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        """``protocol``; ``results``: see :func:`summary`; ``seconds_compile``: of models and, on a GPU, kernels, in no
        rate."""
        seconds = {part.file: made.result for part, made in outcome.made_parts}
        wall = {path: simulating / outcome.lanes for path, (simulating, _) in seconds.items()}
        done = [self._simulated(path, wall.get(path, 0.0)) for path in outcome.paths]
        return {
            "protocol": self.protocol.model_dump(mode="json"),
            "results": summary(done, self.protocol),
            "seconds_compile": sum(compiling for _, compiling in seconds.values()),
        }

    def _simulated(self, path: Path, seconds: float) -> "Simulated":
        prefix = f"physics/{self.protocol.name}_"
        with ShardReader(path, invalid=False) as reader:
            if f"{prefix}holds" not in reader.columns:
                raise ShardError(f"{path}: it was replaced since it got its verdicts; run it again")
            hand = reader.hand()
            return Simulated(
                path=path,
                hand=hand.name,
                objects=self._scene_of(hand, reader.objects()).objects,
                object_index=reader.column("object_index"),
                columns={
                    n: reader.column(prefix + n)
                    for n in COLUMNS | OBJECT_COLUMNS | DRAWN_COLUMNS | LIFT_COLUMNS
                    if prefix + n in reader.columns
                },
                seconds=seconds * len(reader) / max(count_rows(path), 1),  # those of all rows
            )

    def _kind(self) -> str:
        return "cpu" if on_cpu(self.device_used.alias, self.protocol) else "gpu"

    def _scene_of(
        self,
        hand: HandRecord,
        objects: Sequence[ObjectRecord],
        progress: PartProgress | None = None,
        ahead: Callable[[], None] | None = None,
    ) -> Scene:
        """What is simulated of a shard: hand and objects cut into convex pieces.

        Args:
            ahead: done beside, if meshes are cut, which keeps one core busy.
        """
        planes = [b"" if record.tables is None else record.tables.tobytes() for record in objects]
        key = (hand.sha256, *((o.id, mesh_hash(o), plane) for o, plane in zip(objects, planes, strict=True)))

        def make() -> Scene:
            begun: list[Future[None]] = []
            pool = ThreadPoolExecutor(1)

            def cutting() -> None:
                if ahead and not begun:
                    begun.append(pool.submit(ahead))

            try:
                scene = scene_of(hand, objects, cutter(self.cache, self.events, progress, cutting))
                for future in begun:
                    with suppress(Exception):  # a head start; who needs it meets it again
                        future.result()
            finally:
                pool.shutdown(wait=False)  # who stops the job does not wait
            for line in (f"object {solid.name}: {note}" for solid in scene.objects for note in solid.notes):
                if line not in self._said:
                    self._said.add(line)
                    self.cache.warn(line)
            return scene

        return self.cache.kept.get("scene", key, make)


@dataclass(frozen=True)
class Simulated:
    """One shard with its verdicts."""

    path: Path
    hand: str
    objects: tuple[Solid, ...]  # sorted by their ids
    object_index: np.ndarray  # (N, O) position in them, -1 absent
    columns: dict[str, np.ndarray]  # of the protocol, without its name
    seconds: float  # 0: the shard was there already


def summary(done: Sequence[Simulated], protocol: Protocol) -> list[dict[str, Any]]:
    """One entry per hand and objects of a grasp, in the order of its slots: shares that hold, contacts, load, speed.

    Of what is lifted, ``directions_held``, ``directions_run`` and ``contact_at_grasp`` are None; of what is not lifted
    off a table, ``on_table`` and ``pushed``. ``share``: of the draws of a row that hold, mean; ``mass``, ``friction``,
    ``stiffness`` are None if they are drawn.
    """
    groups: dict[Any, list[Simulated]] = {}
    for one in done:
        sets, which = np.unique(one.object_index, axis=0, return_inverse=True)
        for number in np.lexsort([*sets.T[::-1], (sets >= 0).sum(1)]):
            part = _part(one, which.ravel() == number)
            # rows of one object may come with others that have several: these have columns of their own
            alike = one.hand, frozenset(part.columns), *((solid.name, solid.volume) for solid in part.objects)
            groups.setdefault(alike, []).append(part)
    return [_entry(group, protocol) for group in groups.values()]


def _part(one: Simulated, chosen: np.ndarray) -> Simulated:
    """The chosen rows (N,), which have the same objects in the same order, and these objects alone."""
    index = one.object_index[chosen]
    return replace(
        one,
        objects=tuple(one.objects[k] for k in index[0] if k >= 0),
        object_index=index,
        columns={name: values[chosen] for name, values in one.columns.items()},
        seconds=one.seconds * chosen.mean(),
    )


def _entry(group: list[Simulated], protocol: Protocol) -> dict[str, Any]:
    columns = {n: np.concatenate([one.columns[n] for one in group]) for n in group[0].columns if "object_" not in n}
    rows, simulated = len(columns["holds"]), sum(len(one.columns["holds"]) for one in group if one.seconds)
    seconds = float(sum(one.seconds for one in group))
    pulled = columns.get("directions")
    solids = group[0].objects
    loads = [protocol.load(solid.volume) for solid in solids]
    return {
        "hand": group[0].hand,
        "object": "+".join(solid.name for solid in solids),
        "objects": [solid.name for solid in solids],
        "rows": rows,
        "held": int(columns["holds"].sum()),
        "share": float(columns["share"].mean()) if "share" in columns and rows else None,
        "stay": int(columns["stays"].sum()) if "stays" in columns else None,
        "penetration": float(np.median(columns["penetration"])) if "penetration" in columns else None,
        "directions_held": None if pulled is None else (pulled == 1).sum(0).tolist(),
        "directions_run": None if pulled is None else (pulled >= 0).sum(0).tolist(),
        "on_table": int(columns["on_table"].sum()) if "on_table" in columns else None,
        "pushed": float(np.nanmedian(columns["pushed"])) if np.isfinite(columns.get("pushed", np.nan)).any() else None,
        "contact_at_q": int((columns["contact_at_q"] >= _MIN_HOLDING_LINKS).sum()),
        "contact_at_grasp": None if pulled is None else int((columns["contact_at_grasp"] >= _MIN_HOLDING_LINKS).sum()),
        "pregrasp_too_deep": int((columns["pregrasp_penetration"] > protocol.most_penetration).sum()),
        "diverged": int(columns["diverged"].sum()),
        "mass": None if protocol.draws else sum(load.mass for load in loads),
        "friction": None if protocol.draws else protocol.friction,
        "stiffness": None if protocol.draws else max(load.stiffness for load in loads),
        "pieces": sum(len(solid.pieces) for solid in solids),
        "notes": [f"object {solid.name}: {note}" for solid in solids for note in solid.notes],
        "seconds": seconds,
        "per_s": simulated / seconds if seconds else None,
        "shards": [str(one.path) for one in group],
    }


class KeptVerdicts:
    """Columns of the first ``rows`` rows of a shard, with the seconds that they took in all runs, kept in the cache: a
    killed simulation loses the last block of rows.

    Args:
        key: content key of the rows and of all that decides their verdicts.
        protocol: its name, with which the columns begin.
        largest: rows of every block; None: as many as take some seconds.
    """

    def __init__(self, cache: Cache, key: str, protocol: str, *, largest: int | None = None) -> None:
        self._cache, self._key, self._protocol, self._largest = cache, key, protocol, largest
        self.columns: dict[str, np.ndarray] = cache.load(_KIND, key) or {}
        self.seconds, self.compiling = map(float, self.columns.pop(_SECONDS, (0.0, 0.0)))
        self._begin, self._prepared = time.perf_counter(), 0.0

    @property
    def rows(self) -> int:
        """Rows that have a verdict."""
        return len(self.columns[f"{self._protocol}_holds"]) if self.columns else 0

    @property
    def held(self) -> int:
        """Rows that hold."""
        return int(self.columns[f"{self._protocol}_holds"].sum()) if self.columns else 0

    def prepared(self, seconds: float) -> None:
        """Take note of seconds in which models were made."""
        self._prepared += seconds

    def next_block(self, rows: int, threads: int) -> int:
        """Rows to simulate next, of so many in all."""
        rate = self.rows / self.seconds if self.seconds else 0.0
        size = self._largest or (max(int(rate * _BLOCK_SECONDS), threads) if rate else _FIRST * threads)
        self._begin, self._prepared = time.perf_counter(), 0.0
        return min(size, rows - self.rows)

    def add(self, found: dict[str, np.ndarray], *, last: bool) -> None:
        """Add the columns of a block and keep all, unless it is the last."""
        self.seconds += time.perf_counter() - self._begin - self._prepared
        self.compiling += self._prepared
        before = self.columns or {name: values[:0] for name, values in found.items()}
        self.columns = {name: np.concatenate([before[name], values]) for name, values in found.items()}
        if not last:
            self._cache.store(_KIND, self._key, self.columns | {_SECONDS: np.array([self.seconds, self.compiling])})

    def discard(self) -> None:
        """Forget what was kept: the shard has its verdicts."""
        self._cache.discard(_KIND, self._key)
