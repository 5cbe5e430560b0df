"""The numbers of a comparison, from its shards."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from lgrasp.choices import ProtocolName
from lgrasp.dataset.info import last_survivors, stage_counts
from lgrasp.dataset.reader import ShardReader
from lgrasp.dataset.report.write import read_dataset
from lgrasp.jobs.row_counts import strict_rows

MEANS = {
    "yield": "strict rows per pose tried",
    "strict_per_s": "strict rows per second",
    "approach": "share of approach directions",
    "surface": "share of the surface within 5 mm of a contact",
    "contacts": "mean contacts of a row",
    "epsilon": "median",
    "unresisted_load": "median",
    "hold": "share that stays in the hold test",
    "simulated": "share that holds in the simulation",
}
"""Numbers of a hand with an object, of which a hand has the means over its objects."""


def measure_cell(path: Path, protocol: ProtocolName | None) -> dict[str, Any]:
    """Numbers of the shard of a hand and an object.

    Returns:
        ``rows``, the numbers of :data:`MEANS`, ``pca_ratio`` and ``joint_entropy`` (docs/reference/metrics.md); None
        where there is nothing to tell it by.

    Raises:
        ShardError: the shard is damaged.
    """
    with ShardReader(path, invalid=False) as reader:
        rows, statistics = len(reader), reader.statistics
        strict = strict_rows(reader.column, reader.header.config)
        kept = last_survivors(stage_counts(statistics))
        wanted = ("metrics/epsilon", "metrics/unresisted_load", "metrics/hold_success")
        columns = {name: reader.column(name).astype(float) for name in wanted if rows}
        held = f"physics/{protocol}_holds"
        verdicts = reader.column(held) if protocol and rows and held in reader.columns else None
    tried, seconds = int(statistics.get("candidates", 0)), float(statistics.get("seconds_wall", 0.0))
    share = strict / rows if rows else 0.0
    found: dict[str, Any] = {
        "rows": rows,
        "yield": kept * share / tried if tried else None,
        "strict_per_s": strict / seconds if seconds else None,
        "approach": 0.0,
        "surface": 0.0,
        "contacts": None,
        "epsilon": float(np.median(columns["metrics/epsilon"])) if rows else None,
        "unresisted_load": float(np.median(columns["metrics/unresisted_load"])) if rows else None,
        "hold": float(columns["metrics/hold_success"].mean()) if rows else None,
        "simulated": float((verdicts > 0).mean()) if verdicts is not None else None,
        "pca_ratio": None,
        "joint_entropy": None,
    }
    if not rows:
        return found
    numbers, _ = read_dataset([path], near=False)
    (group,) = numbers["hands"][0]["objects"]
    (cover,), (spread,) = group["coverage"].values(), group["diversity"].values()
    told = {"approach": cover["directions"]["share"], "surface": cover["surface"]["share"]}
    contacts = sum(int(n) * count for n, count in group["contacts"].items()) / rows
    return found | told | {"contacts": contacts} | spread


def measure_hand(cells: Mapping[str, Mapping[str, Any]], files: Sequence[Path]) -> dict[str, Any]:
    """Numbers of a hand with all objects: means over them, and the diversity of all rows together.

    Args:
        cells: by object, see :func:`measure_cell`.
        files: their shards.
    """
    found: dict[str, Any] = {"rows": sum(cell["rows"] for cell in cells.values())}
    for name in MEANS:
        known = [cell[name] for cell in cells.values() if cell[name] is not None]
        found[name] = fmean(known) if known else None
    if not found["rows"]:
        return found | {"pca_ratio": None, "joint_entropy": None}
    numbers, _ = read_dataset(list(files), near=False)
    return found | numbers["hands"][0]["diversity"]
