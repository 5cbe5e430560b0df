"""Rows of shards as scenes to look at, read as they are asked for; pictures of them."""

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lgrasp.dataset.conditions import Condition, parse_condition, satisfied
from lgrasp.dataset.files import Paths, check_heaps
from lgrasp.dataset.gather import sound_files
from lgrasp.dataset.reader import ShardReader
from lgrasp.errors import ConfigError, ShardError
from lgrasp.grasp.bounds import stored_bounds
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord
from lgrasp.notices import notice
from lgrasp.runtime.cores import cores
from lgrasp.words import plural

if TYPE_CHECKING:
    from PIL import Image

    from lgrasp.picture.scene import GraspScene, HandShape

_KEPT = 16  # rows, hands and lists of objects that stay in memory


class _Contents(NamedTuple):
    hand: HandRecord
    objects: tuple[ObjectRecord, ...]
    friction: float


class SceneRows:
    """The rows of shards, counted through all of them, of whatever hands and objects.

    Args:
        paths: Shard files, or folders that hold some at any depth.

    Files in folders that cannot be read are left out, with a notice.

    Raises:
        ShardError: No shard is found, one that was named cannot be read, or none has a row.
    """

    def __init__(self, paths: Paths) -> None:
        found = sound_files(paths, _grasps)
        self._grasps = {file: grasps for file, _, grasps in found}
        self.files = list(self._grasps)
        self._ends = list(accumulate(map(len, self._grasps.values())))
        if not len(self):
            raise ShardError(f"{self.files[0]}: no row to look at (shards: {len(self.files)})")
        self._contents = lru_cache(_KEPT)(_contents)
        self._row = lru_cache(_KEPT)(self._read_row)
        self._chosen = lru_cache(1)(lambda where, _: self.chosen(where))
        self._shapes: dict[tuple[str, tuple[str, ...]], HandShape] = {}

    def __len__(self) -> int:
        return self._ends[-1]

    def place(self, row: int) -> tuple[Path, int]:
        """The file of a row, and its number there.

        Raises:
            ConfigError: There is no such row.
        """
        if not 0 <= row < len(self):
            raise ConfigError(f"row {row} does not exist; there are 0 to {len(self) - 1}")
        file = bisect_right(self._ends, row)
        return self.files[file], row - ([0, *self._ends][file])

    @contextmanager
    def _opened(self, path: Path) -> Iterator[ShardReader]:
        """A shard, which must have as many rows as when these were counted.

        Raises:
            ShardError: It is damaged, or another one is in its place.
        """
        with ShardReader(path) as reader:
            if len(reader) != (rows := len(self._grasps[path])):
                now = plural(len(reader), "row")
                raise ShardError(f"{path} was replaced: it has {now} in place of {rows:,}; open it again")
            yield reader

    def _read_row(self, path: Path, number: int, _: int) -> GraspRows:
        with self._opened(path) as reader:
            return reader.rows(number, number + 1)

    def spread(self, count: int) -> list[int]:
        """So many rows evenly over all grasps, or all of these if there are fewer."""
        grasps = self.chosen(())
        grasps = grasps if len(grasps) else np.arange(len(self))  # all rows fail a bound
        count = min(count, len(grasps))
        return [int(grasps[(2 * k + 1) * len(grasps) // (2 * count)]) for k in range(count)]

    def sound(
        self, rows: Iterable[int], most: int | None = None, look: Callable[[int], object] | None = None
    ) -> list[int]:
        """The first of some rows that can be read; a shard with one that cannot is left out from there on.

        Args:
            look: what reads a row, :meth:`scene` or the quicker :meth:`read`.

        Raises:
            ShardError: None can be read.
            ConfigError: There is no such row.
        """
        look = look or self.scene
        sound: list[int] = []
        damaged: dict[Path, ShardError] = {}
        for row in rows:
            path, _ = self.place(row)
            if path in damaged:
                continue
            try:
                look(row)
            except ShardError as error:
                damaged[path] = error
                continue
            sound.append(row)
            if len(sound) == most:
                break
        if not sound:
            raise next(iter(damaged.values()))
        for error in damaged.values():
            notice(f"{error}; it is left out")
        return sound

    def read(self, row: int) -> tuple[HandRecord, tuple[ObjectRecord, ...], GraspRows]:
        """A row alone, with the hand and the objects of its shard.

        Raises:
            ShardError: The shard is damaged.
            ConfigError: There is no such row.
        """
        path, number = self.place(row)
        hand, objects, _ = self._contents(path, _when(path))
        return hand, objects, self._row(path, number, _when(path))

    def scene(self, row: int) -> "GraspScene":
        """The scene of a row.

        Raises:
            ShardError: The shard is damaged, or its hand cannot be used.
            ConfigError: There is no such row.
        """
        from lgrasp.picture.scene import HandShape, scene_of_row  # slow to load

        hand, objects, rows = self.read(row)
        key = hand.sha256, tuple(hand.joint_names)
        if key not in self._shapes:
            self._shapes[key] = HandShape.of_record(hand)
        try:
            return scene_of_row(self._shapes[key], objects, rows, 0)
        except ShardError as error:
            path, number = self.place(row)
            raise ShardError(f"{path}: row {number}: {error}") from None

    def columns(self) -> list[str]:
        """Columns with one number per row, of the first shard."""
        with ShardReader(self.files[0]) as reader:
            return [name for name, (shape, _) in reader.columns.items() if len(shape) == 1]

    def column(self, name: str) -> np.ndarray:
        """One number per row, shape [N], float64.

        Raises:
            ShardError: A shard lacks the column.
        """
        parts = []
        for path in self.files:
            with self._opened(path) as reader:
                parts.append(reader.column(name).astype(np.float64))
        return np.concatenate(parts)

    def chosen(self, where: Sequence[Condition]) -> np.ndarray:
        """Rows that satisfy all conditions, rising; none of a shard that lacks a column, which is told.

        Raises:
            ShardError: All shards lack a column, or one cannot be read.
        """
        if not where:
            return np.flatnonzero(np.concatenate(list(self._grasps.values())))
        good: list[np.ndarray] = []
        lacking: list[ShardError] = []
        for path in self.files:
            with self._opened(path) as reader:
                try:
                    good.append(satisfied(reader, where))
                except ShardError as error:
                    lacking.append(error)
                    good.append(np.zeros(len(reader), bool))
        if len(lacking) == len(self.files):
            raise lacking[0]
        if lacking:
            notice(f"{len(lacking)} of {len(self.files)} shards are left out, first {lacking[0]}")
        return np.flatnonzero(np.concatenate(good))

    def meeting(self, where: str) -> Sequence[int] | np.ndarray:
        """Rows that satisfy conditions, separated by commas; without any, all.

        Raises:
            ConfigError: A condition cannot be read, or no row meets them.
            ShardError: As of :meth:`chosen`.
        """
        conditions = tuple(parse_condition(text) for text in where.split(",") if text.strip())
        if not conditions:
            return range(len(self))
        chosen = self._chosen(conditions, tuple(map(_when, self.files)))
        if not len(chosen):
            raise ConfigError(f"no row of {len(self):,} meets {where}")
        return chosen

    def numbers(self, row: int) -> dict[str, float | list[float]]:
        """Metrics and verdicts of a row by column."""
        path, number = self.place(row)
        with self._opened(path) as reader:
            names = [name for name in reader.columns if name.startswith(("metrics/", "physics/"))]
            return {name: reader.column(name, number, number + 1)[0].tolist() for name in names}

    def friction(self, row: int) -> float:
        """The friction at which the row was checked."""
        path, _ = self.place(row)
        return self._contents(path, _when(path)).friction

    def caption(self, row: int, among: Sequence[int]) -> str:
        """What tells a row from others that can be read: its number, and hand and objects where these differ."""
        known = [row]
        for other in among:
            with suppress(ShardError):
                self.read(other)
                known.append(other)
        return self.captions(known)[0]

    def captions(self, chosen: Sequence[int]) -> list[str]:
        """What tells some rows from each other."""
        names = []
        for row in chosen:
            hand, objects, rows = self.read(row)
            names.append((hand.name, " + ".join(objects[k].id for k in rows.object_index[0] if 0 <= k < len(objects))))
        differing = [k for k in (0, 1) if len({name[k] for name in names}) > 1]
        return [
            " · ".join([*(name[k] for k in differing), f"row {row:,}"]) for row, name in zip(chosen, names, strict=True)
        ]


def draw_rows(rows: SceneRows, chosen: Sequence[int], *, stage: str = "grasp", **options: Any) -> "Image.Image":
    """Rows side by side at a stage: pregrasp, grasp or squeeze; options and errors as of :func:`draw_motion`."""
    from lgrasp.picture.scene import STAGES  # slow to load

    return draw_motion(rows, chosen, [list(STAGES).index(stage)], **options)[0]


def draw_motion(
    rows: SceneRows,
    chosen: Sequence[int],
    times: Sequence[float],
    *,
    size: int,
    columns: int = 0,
    progress: Callable[[int, int], None] | None = None,
    loading: Callable[[str, float], None] | None = None,
) -> "list[Image.Image]":
    """Rows side by side at some times, each with its number.

    Args:
        chosen: At least one.
        times: Rising; 0 pregrasp, 1 grasp, 2 squeeze.
        size: Pixels of a side of each picture.
        columns: 0: about as many as lines.
        progress: Called with (rows done, rows in all).
        loading: Called with (kernels that are ready, share done).

    Raises:
        ShardError: A shard is damaged, or its hand cannot be used.
        ConfigError: There is no such row.
    """
    from lgrasp.picture.draw import draw_scene  # slow to load
    from lgrasp.picture.sheet import sheet
    from lgrasp.runtime.device import start
    from lgrasp.runtime.kernels import kernel_modules, load_kernels

    start()
    load_kernels("cpu", kernel_modules("lgrasp.picture."), loading)
    pictures: list[list[np.ndarray]] = []
    scenes = [rows.scene(row) for row in chosen]
    known = sorted({scene.objects[0].record.id for scene in scenes})
    with ThreadPoolExecutor(cores()) as pool:
        for own in pool.map(lambda s: list(draw_scene(s, size, times, known.index(s.objects[0].record.id))), scenes):
            pictures.append(own)
            if progress:
                progress(len(pictures), len(scenes))
    captions = rows.captions(chosen)
    return [sheet(at, captions, columns) for at in zip(*pictures, strict=True)]


def _when(path: Path) -> int:
    """When a file was written [ns]: it may be replaced, or get verdicts, while its rows are shown."""
    return path.stat().st_mtime_ns if path.exists() else 0


def _grasps(path: Path) -> np.ndarray:
    """Which rows of a shard are grasps, (N,) bool."""
    with ShardReader(path) as reader:
        return satisfied(reader, ())


def _contents(path: Path, _: int) -> _Contents:
    check_heaps(path)
    with ShardReader(path) as reader:
        try:
            friction = stored_bounds(reader.header.config).friction
        except (AttributeError, ConfigError, KeyError, TypeError, ValueError):  # of another writer
            from lgrasp.grasp.wrench_space import FRICTION  # slow to load

            friction = FRICTION
        return _Contents(reader.hand(), reader.objects(), friction)
