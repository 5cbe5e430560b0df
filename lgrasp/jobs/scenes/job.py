"""The job: a hand, objects and their grasps -> scene files in a folder."""

import hashlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from lgrasp.engine.cache import Cache
from lgrasp.engine.folder import check_folder, clean_folder, shard_path
from lgrasp.errors import ConfigError, OutputError, ShardError
from lgrasp.jobs.scenes.config import SceneConfig
from lgrasp.jobs.scenes.stock import Stock, load_stock
from lgrasp.runtime.device import resolve_device
from lgrasp.runtime.kernels import kernel_modules, load_kernels
from lgrasp.scenes.make import make_scene
from lgrasp.scenes.reader import SceneReader, check_scene
from lgrasp.scenes.writer import write_scene
from lgrasp.simulate.builder import import_mujoco


@dataclass(frozen=True)
class SceneJob:
    """What is made and which part of it."""

    config: SceneConfig
    shard_index: int = 0
    num_shards: int = 1
    resume: bool = True
    cache: Cache = field(default_factory=Cache)


class SceneListener:
    """What a job tells while it runs; every method may be overridden."""

    def loading(self, what: str) -> None:
        """An input is being loaded or made."""

    def started(self, scenes: int, present: int) -> None:
        """Inputs are ready; ``present`` of ``scenes`` are on disk already."""

    def wrote(self, index: int, path: Path) -> None:
        """A scene is on disk."""

    def cancelled(self) -> bool:
        """Should the job stop after the running scenes?"""
        return False


@dataclass
class SceneOutcome:
    """What a job did."""

    paths: list[Path]
    """All scenes of this job that are on disk."""
    written: list[Path]
    """Those made by this call."""
    hand: str
    wall: float
    """Of making scenes, without loading [s]."""
    cancelled: bool = False


def scene_numbers(job: SceneJob) -> range:
    """Numbers of the scenes that this job (array task) makes.

    Raises:
        ConfigError: array numbers out of range.
    """
    if job.num_shards <= 0 or not 0 <= job.shard_index < job.num_shards:
        raise ConfigError(f"--shard-index {job.shard_index} --num-shards {job.num_shards}: need 0 <= index < number")
    return range(job.shard_index, job.config.scenes, job.num_shards)


def make_scenes(job: SceneJob, listener: SceneListener | None = None) -> SceneOutcome:
    """Make the missing scenes of a job, several at once.

    Raises:
        LgraspError: bad input, unwritable output, or files of another run in the output folder.
    """
    listener = listener or SceneListener()
    config, numbers = job.config, scene_numbers(job)
    import_mujoco()
    device = resolve_device(config.device)
    check_folder(config.out)
    stock = load_stock(config, job.cache, device, listener.loading)
    described = _described(config, stock)
    files = {index: shard_path(config.out, stock.record.name, "scene", index) for index in numbers}
    clean_folder(list(files.values()))
    present = _present(files, described["run_key"], job.cache.warn) if job.resume else set()
    listener.loading("kernels")
    load_kernels(device.alias, kernel_modules("lgrasp.scenes."))
    listener.started(len(files), len(present))
    start, lock = time.perf_counter(), threading.Lock()
    outcome = SceneOutcome([], [], stock.record.name, 0.0)

    def make(index: int) -> None:
        begin = time.perf_counter()
        scene = make_scene(stock.hand, stock.record, stock.items, config.scene, config.seed, index, device.alias)
        statistics = dict(scene.statistics) | {"device": device.name, "seconds": time.perf_counter() - begin}
        write_scene(files[index], replace(scene, config=described, statistics=statistics))
        with lock:
            outcome.written.append(files[index])
            listener.wrote(index, files[index])

    workers = config.workers or (1 if device.is_cuda else os.cpu_count() or 1)
    missing = (index for index in numbers if index not in present)
    outcome.cancelled = _run(make, missing, workers, listener.cancelled)
    outcome.paths = [path for index, path in files.items() if index in present or path in outcome.written]
    outcome.wall = time.perf_counter() - start
    return outcome


def _run(make: Callable[[int], None], numbers: Iterator[int], workers: int, cancelled: Callable[[], bool]) -> bool:
    """Make scenes, ``workers`` at a time; was the job stopped before the last?"""
    running: set[Future[None]] = set()
    with ThreadPoolExecutor(workers) as pool:
        while True:
            while len(running) < workers and not cancelled():
                index = next(numbers, None)
                if index is None:
                    break
                running.add(pool.submit(make, index))
            if not running:
                return next(numbers, None) is not None
            done, running = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
            for future in done:
                future.result()


def _described(config: SceneConfig, stock: Stock) -> dict[str, Any]:
    """What a scene says of its making, the key of the run among it."""
    content: dict[str, Any] = {"scene": config.scene.model_dump(mode="json"), "seed": config.seed, "stock": stock.key}
    key = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    return content | {"run_key": key, "objects": [item.record.id for item in stock.items]}


def _present(files: dict[int, Path], key: str, warn: Callable[[str], None]) -> set[int]:
    """Scenes that are on disk and may stay.

    Raises:
        OutputError: a file belongs to another run.
    """
    present = set()
    for index, path in files.items():
        if not os.path.lexists(path):
            continue
        problems = check_scene(path)
        if problems:
            warn(f"scene {path} is damaged ({problems[0]}); it is made anew")
            continue
        try:
            with SceneReader(path) as reader:
                found = reader.config.get("run_key")
        except ShardError:
            continue
        if found != key:
            raise OutputError(
                f"{path} belongs to another run (other hand, objects, grasps, parameters or seed); "
                "choose another --out, or --no-resume to replace it"
            )
        present.add(index)
    return present
