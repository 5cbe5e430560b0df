"""Checks a shard file against every MUST of the format."""

import os
from collections.abc import Callable
from typing import Any

import h5py

from lgrasp.dataset.checks import hand_problems, object_problems, row_problems
from lgrasp.dataset.files import check_heaps
from lgrasp.dataset.reader import ShardReader, open_hdf5, reading
from lgrasp.dataset.structure import changed_texts, shard_problems
from lgrasp.errors import ShardError
from lgrasp.grasp.records import object_set_sha256


def validate_shard(path: str | os.PathLike[str]) -> list[str]:
    """All problems of a shard, one line each; an empty list means that it conforms.

    Reads every byte of every dataset of the format, in bounded memory, so checksums are verified. A file that cannot
    be read at all gives one problem, not an error.
    """
    return file_problems(path, shard_problems, _content_problems)


def file_problems(
    path: str | os.PathLike[str],
    structure: Callable[[h5py.File], tuple[dict[str, Any], list[str]]],
    content: Callable[..., list[str]],
) -> list[str]:
    """Problems of a file, those of its structure before those of what it holds, by functions of the file, which gives
    its members too, and of its path; what cannot be read is a problem too."""
    try:
        check_heaps(path)
        with open_hdf5(path) as file, reading(path):
            nodes, problems = structure(file)
            problems = problems or changed_texts(file, nodes)
        return problems or content(path)
    except ShardError as error:
        return [str(error).removeprefix(f"{path}: ")]


def _content_problems(path: str | os.PathLike[str]) -> list[str]:
    with ShardReader(path) as reader, reading(path):
        hand, objects = reader.hand(check=False), reader.objects(check=False)
        problems = [*hand_problems(hand), *(problem for record in objects for problem in object_problems(record))]
        if reader.attributes["object_sha256"] != object_set_sha256(objects):
            problems.append("/: attribute object_sha256 does not belong to the objects")
        try:
            _ = reader.statistics
        except ShardError as error:
            problems.append(str(error).removeprefix(f"{path}: "))
        seen: dict[str, str] = {}  # the first block that shows a problem is enough
        for first_row, rows in reader.blocks():
            for problem in row_problems(rows, hand, objects, reader.column, first_row=first_row):
                seen.setdefault(problem.rpartition(" (row ")[0], problem)
    return [*problems, *seen.values()]
