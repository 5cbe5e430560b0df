"""The numbers of a comparison, from its shards."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

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
    "epsilon": "mean of the rows",
    "unresisted_load": "mean of the rows",
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
        counts = stage_counts(statistics)
        kept, seconds = last_survivors(counts), float(statistics.get("seconds_wall", 0.0))
        # poses near those that gave grasps (close.moves) are no candidates
        tried = max(int(statistics.get("candidates", 0)), counts.get("place", {}).get("tried", 0))
        found: dict[str, Any] = {"rows": rows} | dict.fromkeys([*MEANS, "pca_ratio", "joint_entropy"])
        found |= {"approach": 0.0, "surface": 0.0, "strict_per_s": strict / seconds if seconds else None}
        found["yield"] = kept * (strict / rows if rows else 0.0) / tried if tried else None
        if not rows:
            return found
        for name in ("epsilon", "unresisted_load"):
            found[name] = float(reader.column(f"metrics/{name}").astype(float).mean())
        found["hold"] = float(reader.column("metrics/hold_success").astype(float).mean())
        if protocol and (held := f"physics/{protocol}_holds") in reader.columns:
            found["simulated"] = float((reader.column(held) > 0).mean())
    numbers, _ = read_dataset([path], near=False)
    (group,) = numbers["hands"][0]["objects"]
    (cover,), (spread,) = group["coverage"].values(), group["diversity"].values()
    told = {"approach": cover["directions"]["share"], "surface": cover["surface"]["share"]}
    contacts = sum(int(n) * count for n, count in group["contacts"].items()) / rows
    return found | told | {"contacts": contacts} | spread


def measure_hand(cells: Mapping[str, Mapping[str, Any]], files: Sequence[Path]) -> dict[str, Any]:
    """Numbers of a hand by the :func:`measure_cell` of objects: means over them, and the diversity of all rows
    together."""
    found: dict[str, Any] = {"rows": sum(cell["rows"] for cell in cells.values())}
    for name in MEANS:
        known = [cell[name] for cell in cells.values() if cell[name] is not None]
        found[name] = fmean(known) if known else None
    if not found["rows"]:
        return found | {"pca_ratio": None, "joint_entropy": None}
    numbers, _ = read_dataset(list(files), near=False)
    return found | numbers["hands"][0]["diversity"]
