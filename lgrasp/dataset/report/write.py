"""Makes the report: shards in, one HTML file and the numbers out."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from lgrasp.dataset.files import new_file
from lgrasp.dataset.reader import ShardReader
from lgrasp.dataset.report.gather import HandRows
from lgrasp.dataset.report.page import page
from lgrasp.dataset.report.summary import summary
from lgrasp.dataset.report.survey import survey
from lgrasp.errors import OutputError

_Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


def report_dataset(paths: _Paths, out: Path, *, progress: Callable[[int, int], None] | None = None) -> dict[str, Any]:
    """Write a report on a data set as one self-contained HTML file, without network.

    Args:
        paths: Shard files, or folders that hold some at any depth; of several hands and objects if need be.
        out: The HTML file.
        progress: Called with (rows done, rows in all) now and then.

    Returns:
        The numbers of the report, JSON-serialisable; docs/reference/metrics.md lists them.

    Raises:
        ShardError: No shard is found, or one cannot be read.
        OutputError: ``out`` cannot be written.
    """
    if out.exists() and not out.is_file():
        raise OutputError(f"report {out} cannot be written: it is no regular file; name another")
    numbers, hands = read_dataset(paths, progress=progress)
    text = page(numbers, hands)
    with new_file(out) as file:
        file.write(text.encode())
    return numbers


def read_dataset(
    paths: _Paths, *, progress: Callable[[int, int], None] | None = None
) -> tuple[dict[str, Any], dict[tuple[str, str], HandRows]]:
    """The numbers of a report, and the data of its charts, by name and hash of the hands.

    Shards are read once, some thousand rows at a time; of the rows stay counts, an even sample of at most 50,000 per
    hand for the scatter plots, and poses and joints of one hand with one object at a time to find near-duplicates (some
    200 bytes a row, at most two million rows).

    Raises:
        ShardError: No shard is found, or one cannot be read.
    """
    heads, remarks = survey(paths)
    total, done = sum(head.rows for head in heads), 0
    hands: dict[tuple[str, str], HandRows] = {}
    before = None

    def advanced(rows: int) -> None:
        if progress:
            progress(done + rows, total)

    for head in heads:
        with ShardReader(head.path) as reader:
            if head.hand not in hands:
                hands[head.hand] = HandRows(reader.hand())
            if before is not None and (head.hand, head.labels) != (before.hand, before.labels):
                hands[before.hand].close()
            hands[head.hand].add(reader, head.labels, advanced)
        before = head
        done += head.rows
    return summary(heads, remarks, hands), hands
