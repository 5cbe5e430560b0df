"""Copies a shard and adds columns and statistics to the copy."""

import os
from collections.abc import Mapping

import h5py
import numpy as np

from lgrasp.dataset.reader import open_hdf5, reading
from lgrasp.dataset.structure import changed_texts, members
from lgrasp.dataset.writer import create_rows, finish, new_shard_file
from lgrasp.errors import ShardError


def extend_shard(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    metrics: Mapping[str, np.ndarray] | None = None,
    units: Mapping[str, str] | None = None,
    *,
    physics: Mapping[str, np.ndarray] | None = None,
    protocol: str = "",
    statistics: Mapping[str, int | float | str] | None = None,
) -> None:
    """Write a copy of a shard, members that the format does not know included, with more ``metrics/NAME``,
    ``physics/NAME`` and statistics.

    Stored bytes are copied as they are, so memory stays bounded. What is there already under a name is replaced, of
    verdicts all columns of the same protocol. The same input always gives the same bytes.

    Args:
        source: A shard that conforms; damage would be copied along.
        metrics: Numbers by name, each shape [N].
        physics: Verdicts by name, each shape [N, ...].

    Raises:
        ShardError: The source cannot be read, or a column has another number of rows.
        OutputError: ``out`` cannot be written.
    """
    columns = {f"metrics/{name}": np.asarray(values, "f4") for name, values in (metrics or {}).items()}
    columns |= {f"physics/{name}": np.asarray(values) for name, values in (physics or {}).items()}
    texts = dict.fromkeys(columns, protocol) | {
        f"metrics/{name}": (units or {}).get(name, "") for name in metrics or ()
    }
    with new_shard_file(out) as file, open_hdf5(source) as old, reading(source):
        if problems := changed_texts(old, members(old)):  # the copy would vouch for them
            raise ShardError(f"{source}: {problems[0]}")
        n = old["grasps/q"].shape[0]
        for name, values in columns.items():
            if values.shape[:1] != (n,) or (values.ndim > 1 and name.startswith("metrics/")):
                raise ShardError(f"{source}: {name} has shape {values.shape}, must have {n} rows")
        _copy(old, file, {f"grasps/{name}" for name in (*columns, *_same_verdicts(old["grasps"], columns))})
        for name, values in sorted(columns.items()):
            dataset = create_rows(file, name, values.shape, values.dtype, texts[name])
            if n:
                dataset[...] = values
        file["statistics"].attrs.update(dict(statistics or {}))
        finish(file)


def _same_verdicts(rows: h5py.Group, columns: Mapping[str, np.ndarray]) -> list[str]:
    """Columns ``physics/NAME`` of the same protocols as some that are replaced."""
    texts = {f"physics/{name}": dataset.attrs.get("protocol") for name, dataset in rows.get("physics", {}).items()}
    replaced = {texts[name] for name in columns if name in texts}
    return [name for name, text in texts.items() if text in replaced]


def _copy(old: h5py.Group, new: h5py.Group, leave_out: set[str]) -> None:
    """Attributes and members of a group but for the datasets at some paths."""
    new.attrs.update(old.attrs)
    for name in old:
        path = f"{old.name}/{name}".lstrip("/")
        if path in leave_out:
            continue
        if any(other.startswith(f"{path}/") for other in leave_out):
            _copy(old[name], new.create_group(name), leave_out)
        else:
            old.copy(old[name], new, name)
