"""The job of ``lgrasp refine``: shards, or grasps of other formats, moved by a local search and written again."""

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from lgrasp import __version__
from lgrasp.dataset.checks import refuse_problems
from lgrasp.dataset.exports.formats import read_grasps
from lgrasp.dataset.exports.reading import objects_beside
from lgrasp.dataset.info import closure_share
from lgrasp.dataset.reader import ShardReader, read_shard
from lgrasp.engine.cache import content_key
from lgrasp.engine.events import JobOutcome, Made, Part, PartProgress
from lgrasp.engine.folder import shard_path
from lgrasp.engine.registry import STAGES
from lgrasp.engine.run import Job
from lgrasp.engine.shard_job import ShardJob
from lgrasp.errors import HandError, LgraspError, ShardError, StarvedError
from lgrasp.grasp.bounds import stages_told, stored_bounds
from lgrasp.grasp.records import ObjectRecord, Shard, ShardHeader, now
from lgrasp.hand.arrays import HandArrays
from lgrasp.hand.find import HandSource
from lgrasp.hand.model import HandModel
from lgrasp.jobs.records import SURROUNDED, hand_config, hand_record, mesh_blobs
from lgrasp.jobs.refine.moved import move_rows
from lgrasp.jobs.requests.shards import RefineRequest
from lgrasp.jobs.shard_inputs import arrays_of_shard, named_hand, object_of_shard
from lgrasp.notices import notice
from lgrasp.object.find import MESH_SUFFIXES
from lgrasp.object.load import load_mesh
from lgrasp.object.model import ObjectModel, SteeredObject
from lgrasp.object.steered import steer_object, stored_weights
from lgrasp.steer.demands import Demands

VERSION = 6
"""Raised whenever refined shards change for the same parameters."""


class RefineJob(RefineRequest, ShardJob):
    """Grasps of shards, or of an export of another program, moved by a local search and checked again."""

    command: ClassVar[str] = "refine"
    kernels: ClassVar[tuple[str, ...]] = ("lgrasp.refine.", "lgrasp.grasp.")
    write = Job.write  # of whole shards

    _given: dict[int, Shard] = PrivateAttr(default_factory=dict)  # of an export, by number of the part

    def key(self) -> str:
        described = {
            "params": self.params.model_dump(mode="json"),
            "bounds": self.bounds and self.bounds.describe(),
            "settings": self.settings,
            "keep_invalid": self.keep_invalid,
        }
        return content_key("refine", VERSION, **described)

    def parts(self) -> list[Part]:
        parts = super().parts() if self.form is None else self._parts_of_export(self.form)
        if not any(part.rows for part in parts):
            raise ShardError(f"{', '.join(map(str, self.shards))}: no grasps to refine")
        return parts

    def check_source(self, reader: ShardReader) -> None:
        if reader.header.config.get(SURROUNDED):
            notice(f"{reader.path}: planned beside other things, of which the shard has none: hands may move into them")
        if reader.space_names is not None or len(reader.object_ids) != 1 or reader.columns["object_index"][0][1] != 1:
            raise ShardError(
                f"{reader.path}: rows of several objects cannot be refined; one object to a shard is accepted"
            )

    def whole(self, parts: list[Part], *, some: bool) -> list[Part]:
        return super().whole(parts, some=some) if self.form is None else parts

    def _parts_of_export(self, form: str) -> list[Part]:
        """Grasps in the format of another program: a part of each object and scale, those of one name numbered."""
        source, model = self._named
        self._given = dict(enumerate(_grasp_shards(self.shards[0], form, source, model)))
        self._hands, self._objects = {model.name}, {shard.objects[0].id for shard in self._given.values()}
        parts, named = [], Counter[Path]()
        for number, shard in self._given.items():
            hand, code = model.name, shard.objects[0].id
            first = shard_path(self.folder, hand, code, 0)
            file = shard_path(self.folder, hand, code, named[first])
            parts.append(Part(number, file, len(shard.grasps), self.shards[0], named[first]))
            named[first] += 1
        return parts

    def part_key(self, part: Part) -> str:
        if self.form is None:
            return super().part_key(part)
        shard = self._given[part.number]
        digest = [np.asarray(values).tobytes().hex() for values in (shard.grasps.q, shard.grasps.object_pose)]
        of = [shard.hand.sha256, shard.objects[0].sha256, shard.objects[0].scale]
        return content_key("part", 2, job=self.key(), of=of, rows=digest)

    def make(self, part: Part, progress: PartProgress) -> Made:
        assert part.source is not None
        key = self.part_key(part)  # now: another process may replace the source later
        shard = read_shard(part.source) if self.form is None else self._given[part.number]
        if not len(shard.grasps):
            self.cache.warn(f"{part.source} holds no grasps; it is left out")
            return Made(0)
        _check_rows(part.source, shard)
        hand = self._hand(part.source, shard)
        model = object_of_shard(self.cache, shard.objects[0])
        if "network" in shard.header.config and not len(shard.objects[0].faces):
            self.cache.warn(
                f"{part.source}: a network planned these rows on surfaces that it guessed; here only the points of the "
                "cloud are known, and rows that do not fit them are left out"
            )
        asked, left, config = _asked(part.source, shard, hand, model)
        told = stored_bounds(config, part.source)
        bounds, params = self.numbers(told)
        same = told.model_copy(update={"min_hold_probability": 0.0, "profile": bounds.profile}) == bounds
        by_us = all(made.get("version") == STAGES["filter"].version for made in stages_told(config, "filter"))
        begin = time.perf_counter()
        moved = move_rows(
            hand,
            left,
            shard.grasps,
            params,
            bounds,
            asked=asked,
            planes=shard.objects[0].tables if shard.grasps.table else None,
            keep_invalid=self.keep_invalid,
            stored=self.form is None,
            measured=same and by_us,
            progress=progress,
        )
        if moved.clamped:
            self.cache.warn(
                f"joints of {moved.clamped:,} rows were outside their limits and were clamped before the search: "
                f"{part.source}"
            )
        if moved.far:
            self.cache.warn(
                f"the hands of {moved.far:,} rows are more than half a metre from their object, nothing draws them to "
                f"it: {part.source}"
            )
        if not len(moved.rows):
            self.cache.warn(f"none of the {moved.failed:,} rows passed the checks: {part.source}")
        counts = {
            "refine_failed": moved.failed,
            "refine_tried": len(shard.grasps),
            "refine_replaced": int(moved.rows.metrics["refined"].sum()),
            "refine_valid_before": moved.valid[0],
            "refine_energy_before": moved.energy[0] * len(shard.grasps),  # sums, for merged shards
            "seconds_refine": time.perf_counter() - begin,
        }
        config |= {"bounds": bounds.describe(), "refine": params.model_dump(mode="json")}
        index = part.shard_index
        header = replace(shard.header, config=config, created=now(), lgrasp_version=__version__, shard_index=index)
        verdicts = (name for name in shard.grasps.physics if name.endswith(("_holds", "_ok")))
        judged = tuple(f"{name.rpartition('_')[0]}_" for name in verdicts)
        told = (*judged, *(f"seconds_{name[:-1]}" for name in judged))  # of rows as they were
        statistics = {name: value for name, value in shard.statistics.items() if not name.startswith(told)}
        refined = replace(shard, header=header, grasps=moved.rows, statistics=statistics)
        return Made(len(moved.rows), self.marked(refined, key, counts))

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        """``results``: of each shard hand, object, ``points`` (it is a cloud), rows, refined, valid before and after,
        mean energies, seconds; ``force_closure`` (share)."""
        return {"results": [_entry(path) for path in outcome.paths], "force_closure": closure_share(outcome.paths)}

    def shortfall(self, outcome: JobOutcome) -> LgraspError | None:
        if outcome.rows or not outcome.paths:
            return None
        return StarvedError(f"none of the rows passed the checks; the files in {self.out} hold no grasps")

    @cached_property
    def _named(self) -> tuple[HandSource, HandModel]:
        """The hand of the option."""
        assert self.hand is not None
        return named_hand(self.cache, self.hand)

    def _hand(self, path: Path, shard: Shard) -> HandArrays:
        """The hand of a shard, whatever is installed under its name; ``hand`` is only compared with it."""
        digest = shard.hand.sha256
        if self.hand is not None and (named := self._named[1]).sha256 != digest:
            raise HandError(
                f"{path}: its grasps are of hand '{shard.hand.name}' (hash {digest[:12]}), not of '{named.name}' "
                f"(hash {named.sha256[:12]}); leave --hand out, the hand is in the shard"
            )
        return arrays_of_shard(self.cache, shard.hand, shard.header.config, self.device_used)


def _entry(path: Path) -> dict[str, Any]:
    """What a refined shard says of itself."""
    with ShardReader(path) as reader:
        statistics, attributes = reader.statistics, reader.attributes
        profile = stored_bounds(reader.header.config).told
        refined, valid, energy = (reader.column(f"metrics/{name}") for name in ("refined", "valid", "energy"))
        rows, objects = len(reader), reader.objects()
    tried = max(int(statistics["refine_tried"]), 1)
    return {
        "shard": str(path),
        "hand": str(attributes["hand"]),
        "object": ", ".join(obj.id for obj in objects),
        "points": not any(len(obj.faces) for obj in objects),
        "rows": rows,
        "refined": int(refined.sum()),
        "valid_before": int(statistics["refine_valid_before"]),
        "valid": int(valid.sum()),
        "profile": profile,
        "failed": int(statistics["refine_failed"]),
        "energy_before": float(statistics["refine_energy_before"]) / tried,
        "energy": float(energy.mean()) if rows else None,
        "seconds": float(statistics["seconds_refine"]),
    }


def _asked(
    path: Path, shard: Shard, hand: HandArrays, obj: ObjectModel
) -> tuple[Demands | None, ObjectModel | SteeredObject, dict[str, Any]]:
    """What was asked of the rows of a shard, what of its object may be touched, and its config for moved rows.

    Raises:
        ShardError: it is asked in a form of its own.
    """
    config, record = dict(shard.header.config), shard.objects[0]
    told, left = config.pop("steered", None) or {}, obj
    if record.regions is not None:
        left = steer_object(obj, stored_weights(obj, record.regions, record.touch_share))
    if not told and left is obj:
        return None, obj, config
    asked = Demands.read(told, hand.model, str(path))
    if "pose_count" in told:
        notice(f"{path}: its rows are of given poses; refined hands leave them")
    kept = {name: told[name] for name in told if name != "poses"}
    return asked, left, config | ({"steered": kept} if kept else {})


def _check_rows(path: Path, shard: Shard) -> None:
    """Refuse what cannot be repaired; joints outside their limits can."""
    rows, hand = shard.grasps, shard.hand
    q = np.where(np.isfinite(rows.q), np.clip(rows.q, hand.joint_lower, hand.joint_upper), rows.q)
    columns = rows.columns()
    given = replace(rows, q=q), hand, shard.objects, lambda name, first, end: columns[name][first:end]
    refuse_problems(path, *given, "refined")


def _grasp_shards(path: Path, form: str, source: HandSource, hand: HandModel) -> Iterator[Shard]:
    """Grasps in the format of another program as one shard an object and scale; joints go by their names."""
    found = read_grasps(path, form, joint_names=hand.tree.listed_names)
    rows = found.grasps
    if rows.object_index.shape[1] != 1:
        raise ShardError(f"{path}: grasps of several objects cannot be refined")
    if not len(rows):
        raise ShardError(f"{path}: holds no grasps")
    record = hand_record(hand, mesh_blobs(source.urdf))
    for number, item in enumerate(found.objects):
        chosen = np.flatnonzero(rows.object_index[:, 0] == number)
        if item.mesh is None:
            wanted = f"{objects_beside(path) / item.code}.obj (or {', '.join(MESH_SUFFIXES[1:])})"
            raise ShardError(f"{path}: no mesh of object '{item.code}'; {wanted} is looked for")
        if not (np.isfinite(item.scale) and item.scale > 0):
            raise ShardError(f"{path}: object '{item.code}' has scale {item.scale:g}; a positive number is accepted")
        mesh = load_mesh(item.mesh, scale=item.scale)
        solid = ObjectRecord(
            id=item.code,
            name=item.code,
            scale=item.scale,
            sha256=mesh.sha256,
            watertight=mesh.closed,
            vertices=mesh.vertices.astype(np.float32),
            faces=mesh.faces,
        )
        own = replace(rows.select(chosen), object_index=np.zeros((len(chosen), 1), np.int32))
        header = ShardHeader(
            pipeline=form, seed=0, shard_index=0, config={"read_from": str(path), **hand_config(source)}
        )
        yield Shard(header=header, hand=record, objects=[solid], grasps=own)
