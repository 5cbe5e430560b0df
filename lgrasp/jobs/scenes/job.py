"""The job: a hand, objects and their grasps -> scene files in a folder."""

import hashlib
import json
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from pydantic import PrivateAttr

from lgrasp.dataset.gather import gather
from lgrasp.engine.events import Events, JobOutcome, Made, Part, PartProgress
from lgrasp.engine.folder import Found, shard_path
from lgrasp.engine.run import Job
from lgrasp.errors import ShardError
from lgrasp.jobs.hands import hand_source
from lgrasp.jobs.requests.scenes import SceneRequest
from lgrasp.jobs.scenes.stock import Stock, load_stock
from lgrasp.runtime.optional import import_mujoco
from lgrasp.scenes.files import SceneReader, check_scene, write_scene
from lgrasp.scenes.make import make_scene


class SceneJob(SceneRequest, Job):
    """Scenes of one hand, one a file."""

    command: ClassVar[str] = "scenes make"
    kernels: ClassVar[tuple[str, ...]] = ("lgrasp.scenes.",)
    one_key: ClassVar[bool] = False
    differs: ClassVar[str] = "other hand, objects, grasps, parameters or seed"
    _stock: Stock | None = PrivateAttr(None)

    @property
    def hand_name(self) -> str:
        """The hand's name: that of the grasps, else of the hand that is asked for."""
        if self.grasps is None:
            return hand_source(self.hand or "allegro").name
        return gather(self.grasps, lambda reader: str(reader.attributes["hand"]))[0].value

    @property
    def loaded(self) -> Stock:
        """Hand, objects and grasps; loaded, and grasps generated, when they are asked for."""
        if self._stock is None:
            self._stock = load_stock(self, self.cache, self.device_used, self.events)
        return self._stock

    def key(self) -> str:
        return hashlib.sha256(json.dumps(self._described(), sort_keys=True).encode()).hexdigest()

    def about(self) -> dict[str, Any]:
        return {"hand": self.hand_name, "objects": [i.record.id for i in self.loaded.items], "seed": self.seed}

    def parts(self) -> list[Part]:
        import_mujoco()
        name = self.hand_name
        return [Part(index, shard_path(self.out, name, "scene", index), 1) for index in range(self.scenes)]

    def found(self, part: Part) -> Found:
        if problems := check_scene(part.file):
            raise ShardError(problems[0])
        with SceneReader(part.file) as reader:
            return Found(reader.config.get("run_key"), 1, shard=reader.index)

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


def describe_scenes(paths: Sequence[Path]) -> dict[str, Any]:
    """Counts over scenes: ``scenes``, points, grasps tested, free and kept; of each object the same (``objects``).

    Raises:
        ShardError: a file is damaged.
    """
    names = ("points", "bytes", "drops", "grasps_tested", "grasps_free", "grasps_into_table", "grasps_into_objects")
    total = Counter({"scenes": len(paths)} | dict.fromkeys(names, 0))
    objects: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for path in paths:
        with SceneReader(path) as reader:
            scene, statistics = reader.layout(), reader.statistics
            grasps, labels = reader.grasps(), reader.cloud().labels
        total.update(points=len(labels), bytes=path.stat().st_size)
        total.update({name: int(statistics[name]) for name in names[2:]})
        for k, index in enumerate(scene.object_index):
            free = grasps.collision_free[grasps.target == k]
            points, without = int((labels == k + 1).sum()), int(not free.any())
            objects[scene.ids[index]].update(
                scenes=1, points=points, kept=len(free), free=int(free.sum()), without=without
            )
    found = {name: dict(counts) for name, counts in sorted(objects.items())}
    return {**total, "object_points": sum(counts["points"] for counts in found.values()), "objects": found}
