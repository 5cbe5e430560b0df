"""Copies a shard and adds numbers per grasp to the copy."""

import os
from collections.abc import Mapping

import h5py
import numpy as np

from lgrasp.dataset.files import new_shard_file
from lgrasp.dataset.reader import open_hdf5, reading
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import create_rows, finish
from lgrasp.errors import ShardError


def check_shard(path: str | os.PathLike[str]) -> None:
    """Fail at a shard that does not conform.

    Raises:
        ShardError: With its first problem.
    """
    problems = validate_shard(path)
    if problems:
        raise ShardError(f"{path}: {problems[0]}")


def extend_shard(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    metrics: Mapping[str, np.ndarray],
    units: Mapping[str, str],
) -> None:
    """Write a copy of a shard, members that the format does not know included, with more ``metrics/NAME``.

    Stored bytes are copied as they are, so memory stays bounded. A metric that is there already is replaced. The same
    input always gives the same bytes.

    Args:
        source: A shard that conforms (see :func:`check_shard`); damage would be copied along.
        out: The file to write.
        metrics: Numbers by name, each shape [N].
        units: Unit by name.

    Raises:
        ShardError: The source cannot be read, or a metric has another number of rows.
        OutputError: ``out`` cannot be written.
    """
    with new_shard_file(out) as file, open_hdf5(source) as old, reading(source):
        n = old["grasps/q"].shape[0]
        wrong = [name for name, values in metrics.items() if np.shape(values) != (n,)]
        if wrong:
            raise ShardError(f"{source}: metric {wrong[0]} has shape {np.shape(metrics[wrong[0]])}, must be ({n},)")
        _copy(old, file, {f"grasps/metrics/{name}" for name in metrics})
        for name in sorted(metrics):
            dataset = create_rows(file, f"metrics/{name}", (n,), np.dtype("f4"), unit=units[name])
            if n:
                dataset[...] = metrics[name]
        finish(file)


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
