"""The job: a hand, objects and their grasps -> scene files in a folder."""

import hashlib
import json
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from pydantic import PrivateAttr

from lgrasp.dataset.files import shard_tree
from lgrasp.dataset.reader import ShardReader
from lgrasp.engine.events import Events, Made, Part, PartProgress
from lgrasp.engine.folder import shard_path
from lgrasp.engine.run import JobOutcome
from lgrasp.errors import OutputError
from lgrasp.jobs.hands import hand_source
from lgrasp.jobs.scenes.config import SceneConfig
from lgrasp.jobs.scenes.report import describe_scenes
from lgrasp.jobs.scenes.stock import Stock, load_stock
from lgrasp.scenes.files import SceneReader, check_scene, write_scene
from lgrasp.scenes.make import make_scene
from lgrasp.simulate.builder import import_mujoco


class SceneJob(SceneConfig):
    """Scenes of one hand, one a file."""

    unit: ClassVar[str] = "scenes"
    kernels: ClassVar[tuple[str, ...]] = ("lgrasp.scenes.",)
    _stock: Stock | None = PrivateAttr(None)

    @property
    def folder(self) -> Path:
        return self.out

    @property
    def hand_name(self) -> str:
        """The hand's name: that of the grasps, else of the hand that is asked for."""
        if self.grasps is None:
            return hand_source(self.hand or "allegro").name
        with ShardReader(next(iter(shard_tree([self.grasps]).values()))) as reader:
            return str(reader.attributes["hand"])

    @property
    def loaded(self) -> Stock:
        """Hand, objects and grasps; loaded, and grasps generated, when they are asked for."""
        if self._stock is None:
            self._stock = load_stock(self, self.cache, self.device_used, self.events.loading)
        return self._stock

    def key(self) -> str:
        return hashlib.sha256(json.dumps(self._described(), sort_keys=True).encode()).hexdigest()

    def parts(self) -> list[Part]:
        import_mujoco()
        name = self.hand_name
        return [Part(index, shard_path(self.out, name, "scene", index), 1) for index in range(self.scenes)]

    def present(self, parts: Sequence[Part]) -> dict[int, int]:
        present = {}
        for part in parts:
            if not os.path.lexists(part.file):
                continue
            problems = check_scene(part.file)
            if problems:
                self.cache.warn(f"scene {part.file} is damaged ({problems[0]}); rebuilding it")
                continue
            with SceneReader(part.file) as reader:
                found = reader.config.get("run_key")
            if found != self.key():
                raise OutputError(
                    f"{part.file} belongs to another run (other hand, objects, grasps, parameters or seed); "
                    "choose another --out, or --overwrite to replace it"
                )
            present[part.number] = 1
        return present

    def load(self, events: Events, missing: bool) -> None:
        if missing:
            assert self.loaded.items

    def at_once(self) -> int:
        return self.threads()

    def make(self, part: Part, progress: PartProgress) -> Made:
        begin, stock, device = time.perf_counter(), self.loaded, self.device_used
        scene = make_scene(stock.hand, stock.record, stock.items, self.scene, self.seed, part.number, device.alias)
        statistics = dict(scene.statistics) | {"device": device.name, "seconds": time.perf_counter() - begin}
        described = self._described() | {"run_key": self.key(), "objects": [item.record.id for item in stock.items]}
        return Made(1, replace(scene, config=described, statistics=statistics))

    def write(self, part: Part, contents: Any) -> None:
        write_scene(part.file, contents)

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        """The contents of the scenes (see :func:`describe_scenes`), ``hand`` and ``scenes_per_minute``."""
        seconds, made = outcome.seconds["parts"], len(outcome.written)
        return describe_scenes(outcome.paths) | {
            "hand": self.hand_name,
            "seconds": {"scenes": seconds},
            "scenes_per_minute": 60.0 * made / seconds if made else None,
        }

    def _described(self) -> dict[str, Any]:
        """What decides the scenes."""
        return {"scene": self.scene.model_dump(mode="json"), "seed": self.seed, "stock": self.loaded.key}
