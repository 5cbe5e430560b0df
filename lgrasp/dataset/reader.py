"""Reads shards: whole, or lazily by rows."""

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

import h5py
import numpy as np

from lgrasp.dataset.checks import hand_problems, object_problems
from lgrasp.dataset.files import check_heaps, check_regular
from lgrasp.dataset.structure import changed_texts, expand, format_problems, shard_problems
from lgrasp.errors import ShardError, short_reason
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord, SequenceRows, Shard, ShardHeader
from lgrasp.grasp.schema import CHUNK_ROWS, FORMAT, FORMAT_VERSION, GRASP_FIELDS, SEQUENCE_FIELDS, TABLE_FIELDS

_RENAMED = {"metrics/disturbance": "metrics/unresisted_load"}
"""Flat names of columns in shards of earlier releases -> their names; readers give the columns by these."""


@contextmanager
def reading(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn whatever HDF5 raises about a damaged file into a ShardError that names the file."""
    try:
        yield
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, MemoryError) as error:
        raise ShardError(f"{path}: cannot be read, it is damaged: {short_reason(error)}") from error


def open_hdf5(path: str | os.PathLike[str]) -> h5py.File:
    """Open an HDF5 file for reading, without a lock (a shard never changes once it has its name).

    Raises:
        ShardError: No such file, not permitted, or not a whole HDF5 file.
    """
    try:
        check_regular(path)
        with open(path, "rb"):
            try:
                return h5py.File(path, "r", locking=False)
            except OSError:
                return h5py.File(path, "r")  # as this process may have it open, with a lock
    except OSError as error:
        reason = error.strerror or " ".join(str(error).split())
        kind = "" if error.strerror else "not a whole HDF5 file: "
        raise ShardError(f"{path}: {kind}{reason[:200]}") from error


class FileReader:
    """An open file with a hand and objects; a context manager. Opening reads no array.

    Raises:
        ShardError: On opening, the file is truncated, foreign, of another format version or not of the format's
            structure; on reading, a checksum does not match, or values of the hand or an object violate the format.
    """

    def __init__(
        self, path: str | os.PathLike[str], problems: Callable[[h5py.File], tuple[dict[str, Any], list[str]]]
    ) -> None:
        self.path = Path(path)
        self._file = open_hdf5(self.path)
        try:
            with reading(self.path):
                self._nodes, found = problems(self._file)
            self._require(found)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; closing twice is harmless."""
        self._file.close()

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """The root attributes as stored (``config`` is JSON text)."""
        with reading(self.path):
            return dict(self._file.attrs)

    @cached_property
    def object_ids(self) -> list[str]:
        """Sorted object ids; ``object_index`` counts in this list."""
        return [path.removeprefix("objects/") for path in expand(self._nodes, "objects/*")]

    def hand(self, *, check: bool = True) -> HandRecord:
        """The hand, with its mesh files; ``check``: refuse values that violate the format."""
        with reading(self.path):
            nodes, attrs = self._nodes, self.attributes
            blobs = [nodes[path] for path in sorted(expand(nodes, "hand/meshes/*"), key=lambda n: (len(n), n))]
            record = HandRecord(
                name=attrs["hand"],
                base_link=nodes["hand"].attrs["base_link"],
                urdf=nodes["hand/urdf"].asstr()[()],
                joint_names=tuple(nodes["hand/joint_names"].asstr()[()]),
                joint_lower=nodes["hand/joint_lower"][()],
                joint_upper=nodes["hand/joint_upper"][()],
                link_names=tuple(nodes["hand/link_names"].asstr()[()]),
                sha256=attrs["hand_sha256"],
                meshes={blob.attrs["path"]: blob[()].tobytes() for blob in blobs},
            )
            changed = changed_texts(self._file, nodes) if check else []
        self._require(check and (changed or hand_problems(record)))
        return record

    def object(self, object_id: str, *, check: bool = True) -> ObjectRecord:
        """One object with its mesh; ``check`` as of :meth:`hand`."""
        with reading(self.path):
            if object_id not in self.object_ids:
                raise ShardError(f"{self.path}: no object {object_id!r}; it has {', '.join(self.object_ids)}")
            here = f"objects/{object_id}"
            nodes, attrs = self._nodes, self._nodes[here].attrs
            parts = {name: nodes.get(f"{here}/{name}") for name in ("normals", "tables", "regions")}
            record = ObjectRecord(
                id=object_id,
                name=attrs["name"],
                scale=float(attrs["scale"]),
                sha256=attrs["sha256"],
                watertight=bool(attrs["watertight"]),
                vertices=nodes[f"{here}/vertices"][()],
                faces=nodes[f"{here}/faces"][()],
                **{name: part[()] for name, part in parts.items() if part is not None},
                touch_share=float(attrs.get("touch_share", 1.0)),
            )
        self._require(check and object_problems(record))
        return record

    def objects(self, *, check: bool = True) -> tuple[ObjectRecord, ...]:
        """All objects, sorted by id; ``check`` as of :meth:`hand`."""
        return tuple(self.object(i, check=check) for i in self.object_ids)

    def _require(self, problems: list[str] | Literal[False]) -> None:
        """A ShardError if there are problems."""
        if problems:
            raise ShardError(f"{self.path}: {problems[0]}")

    @property
    def statistics(self) -> dict[str, int | float | str]:
        """Counts and seconds, device name."""
        with reading(self.path):
            attrs = self._nodes["statistics"].attrs
            found = {k: v.item() if isinstance(v, np.generic) else v for k, v in sorted(attrs.items())}
        wrong = [name for name, value in found.items() if not isinstance(value, int | float | str)]
        self._require([f"statistics: attribute {name} is neither a number nor a string" for name in wrong])
        return found


class ShardReader(FileReader):
    """One open shard; rows are read on demand.

    Args:
        invalid: False: as if rows with metric ``valid`` 0 (kept though they fail a bound) were not in the file.
    """

    def __init__(self, path: str | os.PathLike[str], *, invalid: bool = True) -> None:
        super().__init__(path, shard_problems)
        self._all = invalid

    def __len__(self) -> int:
        return self._dataset("q").shape[0] if self.taken is None else len(self.taken)

    @cached_property
    def taken(self) -> np.ndarray | None:
        """Rows of the file that are read, rising; None if all are."""
        if self._all or "metrics/valid" not in self.columns:
            return None
        with reading(self.path):
            valid = self._dataset("metrics/valid")[()] != 0
        return None if valid.all() else np.flatnonzero(valid)

    def take(self, rows: np.ndarray) -> None:
        """From now on as if only some of the rows, bool, shape [N], were in the file."""
        taken = np.arange(len(self)) if self.taken is None else self.taken
        self.taken = taken[rows]

    @cached_property
    def space_names(self) -> tuple[str, ...] | None:
        """Opposition spaces of the hand that ``sequence/space`` counts in; None if the rows are no sequences."""
        with reading(self.path):
            found = self._nodes.get("sequence/space_names")
            return None if found is None else tuple(found.asstr()[()])

    @cached_property
    def columns(self) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
        """Shape, and dtype in the byte order of this computer, of every row dataset by its flat name (``q``,
        ``metrics/gap``, ...)."""
        names = [*GRASP_FIELDS, *(SEQUENCE_FIELDS if self.space_names is not None else ())]
        names += TABLE_FIELDS if "grasps/table" in self._nodes else ()
        for path in (path for group in ("metrics", "physics") for path in expand(self._nodes, f"grasps/{group}/*")):
            name = path.removeprefix("grasps/")
            names.append(_RENAMED.get(name, name))
        found = {name: self._dataset(name) for name in names}
        return {name: (dataset.shape, dataset.dtype.newbyteorder("=")) for name, dataset in found.items()}

    @property
    def object_keys(self) -> list[tuple[str, str, float]]:
        """Id, hash and scale of every object, sorted by id."""
        with reading(self.path):
            objects = [(name, self._nodes[f"objects/{name}"].attrs) for name in self.object_ids]
            return [(name, attrs["sha256"], float(attrs["scale"])) for name, attrs in objects]

    def column(self, name: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows ``start`` to ``stop`` of one dataset by its flat name; names of earlier releases do too.

        Raises:
            ShardError: The shard has no such dataset, or its bytes are damaged.
        """
        name = _RENAMED.get(name, name)
        if name not in self.columns:
            raise ShardError(f"{self.path}: no dataset {name!r}; it has {', '.join(self.columns)}")
        with reading(self.path):
            dataset, native = self._dataset(name), self.columns[name][1]
            if self.taken is None:
                return dataset[start:stop].astype(native, copy=False)
            rows = self.taken[start:stop]
            first, end = (rows[0], rows[-1] + 1) if len(rows) else (0, 0)
            values = dataset[first:end][rows - first].astype(native, copy=False)
            if name == "sequence/parent":
                place = np.append(np.full(self._dataset("q").shape[0], -1), -1)  # the last of rows without parent
                place[self.taken] = np.arange(len(self.taken))
                values = place[values]
            return values

    def rows(self, start: int = 0, stop: int | None = None) -> GraspRows:
        """Rows ``start`` to ``stop`` of everything under ``/grasps``."""
        values = {name: self.column(name, start, stop) for name in self.columns}
        fields: dict[str, Any] = {name: values.pop(name) for name in GRASP_FIELDS}
        for group, texts, attribute in (
            ("metrics", "metric_units", "unit"),
            ("physics", "physics_protocols", "protocol"),
        ):
            members = {n.partition("/")[2]: v for n, v in values.items() if n.startswith(f"{group}/")}
            fields[group] = members
            fields[texts] = {n: self._dataset(f"{group}/{n}").attrs[attribute] for n in members}
        fields["table"] = {n.partition("/")[2]: v for n, v in values.items() if n in TABLE_FIELDS}
        if self.space_names is not None:
            steps = {name.removeprefix("sequence/"): values[name] for name in SEQUENCE_FIELDS}
            fields["sequence"] = SequenceRows(space_names=self.space_names, **steps)
        return GraspRows(**fields)

    def blocks(self) -> Iterator[tuple[int, GraspRows]]:
        """First row and rows of each chunk of the file: all rows in bounded memory."""
        for start in range(0, len(self), CHUNK_ROWS):
            yield start, self.rows(start, start + CHUNK_ROWS)

    def check_whole(self) -> None:
        """Read all there is, so that every checksum is compared.

        Raises:
            ShardError: The file is damaged.
        """
        check_heaps(self.path)
        for _ in self.blocks():
            pass

    @property
    def header(self) -> ShardHeader:
        """Where the rows come from."""
        attrs = self.attributes
        with reading(self.path):
            return ShardHeader(
                pipeline=attrs["pipeline"],
                seed=int(attrs["seed"]),
                shard_index=int(attrs["shard_index"]),
                created=attrs["created"],
                lgrasp_version=attrs["lgrasp_version"],
                config=json.loads(attrs["config"]),
                merged_from=tuple(json.loads(attrs.get("merged_from", "[]"))),
            )

    def _dataset(self, name: str) -> h5py.Dataset:
        with reading(self.path):
            path = GRASP_FIELDS[name].path if name in GRASP_FIELDS else f"grasps/{name}"
            old = next((f"grasps/{was}" for was, now in _RENAMED.items() if now == name), None)
            return self._nodes[old if old and old in self._nodes and path not in self._nodes else path]


def count_rows(path: str | os.PathLike[str]) -> int:
    """How many rows a shard says it has; the rest of the file is not looked at.

    Raises:
        ShardError: The file is truncated, foreign, or of another format version.
    """
    with open_hdf5(path) as file, reading(path):
        problems = format_problems(file, "grasp shard", FORMAT, FORMAT_VERSION)
        rows = file.get("grasps/q")
        if problems or not isinstance(rows, h5py.Dataset):
            raise ShardError(f"{path}: {next(iter(problems), 'grasps/q: missing dataset')}")
        return rows.shape[0] if rows.shape else 0


def read_shard(path: str | os.PathLike[str]) -> Shard:
    """Read a whole shard.

    Raises:
        ShardError: The file is damaged, foreign or of another format version; the message says which.
    """
    check_heaps(path)
    with ShardReader(path) as reader:
        return Shard(
            header=reader.header,
            hand=reader.hand(),
            objects=reader.objects(),
            grasps=reader.rows(),
            statistics=reader.statistics,
        )
