"""The judge's findings, as numbers, as JSON and as text."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import starmap
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.judge.checks import CHECKS
from lgrasp.judge.duplicates import Repeats


@dataclass
class ShardVerdict:
    """Findings over the judged rows of one shard; ``rows`` (n,) are their places in the file.

    Attributes:
        kept_invalid: rows that the file itself calls invalid (metric ``valid`` 0); they count apart.
        values, failed: recomputed numbers and failures by check, (n,) each.
        metrics: absolute deviations of stored metrics from recomputed numbers, (n,) each.
        held: objects in each row.
        claims: what the file says of itself.
    """

    path: Path
    total_rows: int
    rows: np.ndarray
    kept_invalid: np.ndarray
    values: dict[str, np.ndarray]
    failed: dict[str, np.ndarray]
    metrics: dict[str, np.ndarray]
    held: np.ndarray
    self_pairs: Counter[str]
    claims: dict[str, str]
    notes: list[str]

    @property
    def valid(self) -> np.ndarray:
        """Rows that pass every strict check, (n,)."""
        return ~np.any(list(self.failed.values()), axis=0)

    def to_dict(self) -> dict[str, Any]:
        """Counts and failing checks."""
        counted = _counts(self.valid, self.kept_invalid, self.failed, self.values)
        counted["kept_invalid_but_valid"] = int((self.kept_invalid & self.valid).sum())
        told = {"claims": self.claims, "notes": self.notes}
        return {"path": str(self.path), "total_rows": self.total_rows, **counted, **told}


def _counts(
    valid: np.ndarray, kept: np.ndarray, failed: Mapping[str, np.ndarray], values: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """Rows, valid ones, and by check that some fail how many, the worst value and the bound; rows kept as invalid."""
    failures: dict[str, dict[str, float]] = {}
    for check, (value, bound) in CHECKS.items():
        mask = failed[check] & ~kept
        if mask.any():
            worst = {"worst": float(values[value][mask].max()), "bound": bound} if value else {}
            failures[check] = {"rows": int(mask.sum()), **worst}
    return {
        "rows": int((~kept).sum()),
        "valid_rows": int((valid & ~kept).sum()),
        "failures": failures,
        "kept_invalid_rows": int(kept.sum()),
    }


class Report:
    """Findings over all judged rows of all shards; arrays are those of :class:`ShardVerdict` one after another.

    Attributes:
        shards: findings by shard.
        repeats: near-duplicates and distinct object poses, counted over all rows of the input, judged or not.
        seconds, seconds_load: time of the checks, and of reading and preparing hands and objects.
    """

    def __init__(self, shards: Sequence[ShardVerdict], repeats: Repeats, seconds: float, seconds_load: float) -> None:
        self.shards, self.repeats, self.seconds, self.seconds_load = tuple(shards), repeats, seconds, seconds_load
        self.values = {k: np.concatenate([s.values[k] for s in shards]) for k in shards[0].values}
        self.failed = {k: np.concatenate([s.failed[k] for s in shards]) for k in CHECKS}
        self.valid = np.concatenate([s.valid for s in shards])
        self.kept_invalid = np.concatenate([s.kept_invalid for s in shards])
        self.held = np.concatenate([s.held for s in shards])
        self.rows, self.total_rows = len(self.valid), sum(s.total_rows for s in shards)
        self.notes = list(dict.fromkeys(n for s in shards for n in s.notes))

    @property
    def passed(self) -> bool:
        """Whether there are judged rows that the files do not call invalid themselves, and all are strictly valid."""
        return self.valid_share == 1.0

    @property
    def valid_share(self) -> float:
        """Of the judged rows that the files do not call invalid themselves."""
        claimed = ~self.kept_invalid
        return float(self.valid[claimed].mean()) if claimed.any() else 0.0

    @property
    def failures(self) -> dict[str, int]:
        """Rows failing each check; a row may fail several."""
        return {k: int((v & ~self.kept_invalid).sum()) for k, v in self.failed.items()}

    @property
    def self_pairs(self) -> dict[str, int]:
        """Pairs of links with self-penetration beyond the bound and their rows, most first."""
        return dict(sum((s.self_pairs for s in self.shards), Counter()).most_common())

    @property
    def distributions(self) -> dict[str, dict[str, float]]:
        """Largest, 99th percentile and median of each recomputed number."""
        return _spread(self.values)

    @property
    def metrics(self) -> dict[str, dict[str, float]]:
        """Deviations of stored metrics from recomputed numbers."""
        names = dict.fromkeys(name for s in self.shards for name in s.metrics)
        return _spread({k: np.concatenate([s.metrics[k] for s in self.shards if k in s.metrics]) for k in names})

    @property
    def by_objects(self) -> dict[int, dict[str, float]]:
        """By number of objects held: rows, valid ones, and of these the penetration of hand and objects [mm]."""
        out = {}
        for held in np.unique(self.held):
            mask = self.held == held
            good = mask & self.valid
            out[int(held)] = {"rows": int(mask.sum()), "valid": int(good.sum())}
            for name, key in (("hand", "penetration_mm"), ("objects", "object_object_mm")):
                found = _spread({"": self.values[key][good]}).get("", {})
                out[int(held)] |= {f"{name} {k}": found.get(k, math.nan) for k in ("max", "p50")}
        return out

    def to_dict(self) -> dict[str, Any]:
        """Everything but the rows' own numbers, fit for JSON; numbers that are not finite are None."""
        out = {
            **_counts(self.valid, self.kept_invalid, self.failed, self.values),
            "total_rows": self.total_rows,
            "valid_share": self.valid_share,
            "shards": [s.to_dict() for s in self.shards],
            "distributions": self.distributions,
            "stored_metrics": self.metrics,
            "near_duplicates": self.repeats.combined,
            "near_duplicates_max": self.repeats.largest,
            "near_duplicate_share": self.repeats.combined / max(self.total_rows, 1),
            "distinct_object_poses": self.repeats.distinct_poses,
            "by_objects": self.by_objects,
            "self_penetration_pairs": self.self_pairs,
            "notes": self.notes,
            "seconds": self.seconds,
            "seconds_load": self.seconds_load,
        }
        return _finite(out)

    def __str__(self) -> str:
        return "\n".join([*self._shard_lines(), "", *self._total_lines(), *(f"note: {n}" for n in self.notes)])

    def _shard_lines(self) -> Iterable[str]:
        width = max(5, *(len(s.path.name) for s in self.shards))
        yield f"{'shard':<{width}}{'rows':>8}{'valid':>8}{'share':>10}  failing checks: rows (worst, bound)"
        for s in self.shards:
            d = s.to_dict()
            share = f"{100.0 * d['valid_rows'] / d['rows']:.2f} %" if d["rows"] else "-"
            line = f"{s.path.name:<{width}}{d['rows']:>8}{d['valid_rows']:>8}{share:>10}  "
            line += ", ".join(starmap(_failure, d["failures"].items())) or "none"
            line += f"; made for profile {s.claims['profile']}" if s.claims.get("profile", "strict") != "strict" else ""
            if d["kept_invalid_rows"]:
                line += f"; kept as invalid: {d['kept_invalid_rows']}, of which {d['kept_invalid_but_valid']} pass"
            yield line

    def _total_lines(self) -> Iterable[str]:
        claimed = ~self.kept_invalid
        yield (
            f"strictly valid   {int(self.valid[claimed].sum())} of {int(claimed.sum())} judged rows "
            f"({100 * self.valid_share:.2f} %), {self.total_rows} rows in the input"
        )
        share = 100 * self.repeats.combined / max(self.total_rows, 1)
        yield f"near-duplicates  {self.repeats.combined} ({share:.2f} %), by largest ratio {self.repeats.largest}"
        yield f"object poses     {self.repeats.distinct_poses} distinct"
        yield f"time             {self.seconds:.1f} s, reading and preparing {self.seconds_load:.1f} s"
        yield from _table("recomputed", self.distributions)
        yield from _table("stored metric, deviation", self.metrics)
        if set(self.by_objects) - {1}:
            yield from _table("objects held", {str(k): v for k, v in self.by_objects.items()})
        if self.self_pairs:
            yield "self-penetrating pairs: " + ", ".join(f"{k} {v}" for k, v in list(self.self_pairs.items())[:12])


def _failure(check: str, found: Mapping[str, float]) -> str:
    worst = f" ({found['worst']:.3g}, {found['bound']:.3g})" if "worst" in found else ""
    return f"{check} {found['rows']}{worst}"


def _spread(values: Mapping[str, np.ndarray]) -> dict[str, dict[str, float]]:
    finite = {k: v[np.isfinite(v)] for k, v in values.items()}
    shares = {"max": 1.0, "p99": 0.99, "p50": 0.5}
    return {k: {n: float(np.quantile(v, s)) for n, s in shares.items()} for k, v in finite.items() if len(v)}


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _table(head: str, rows: Mapping[str, Mapping[str, float]]) -> Iterable[str]:
    if rows:
        yield ""
        yield f"{head:<30}" + "".join(f"{name:>12}" for name in next(iter(rows.values())))
        yield from (f"{name:<30}" + "".join(f"{x:>12.4g}" for x in row.values()) for name, row in rows.items())
