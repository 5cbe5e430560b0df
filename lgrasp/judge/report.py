"""The judge's findings, as numbers, as JSON and as text."""

import json
import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.judge.checks import CHECKS
from lgrasp.judge.duplicates import Repeats


@dataclass(repr=False, eq=False)
class JudgedRows:
    """Findings over judged rows; arrays have one number a row.

    Attributes:
        total_rows: judged or not.
        kept_invalid: rows that the file itself calls invalid (metric ``valid`` 0); they count apart.
        values, failed: recomputed numbers and failures by check.
        held: objects in each row.
        valid: rows that pass every strict check.
    """

    total_rows: int
    kept_invalid: np.ndarray
    values: dict[str, np.ndarray]
    failed: dict[str, np.ndarray]
    held: np.ndarray

    def __post_init__(self) -> None:
        self.valid = ~np.any(list(self.failed.values()), axis=0)

    def counts(self) -> dict[str, Any]:
        """Rows, valid ones, by check that some fail how many, the worst value and the bound; rows kept as invalid."""
        failures: dict[str, dict[str, float]] = {}
        for check, (value, bound) in CHECKS.items():
            mask = self.failed[check] & ~self.kept_invalid
            if mask.any():
                worst = {"worst": float(self.values[value][mask].max()), "bound": bound} if value else {}
                failures[check] = {"rows": int(mask.sum()), **worst}
        return {
            "rows": int((~self.kept_invalid).sum()),
            "valid_rows": int((self.valid & ~self.kept_invalid).sum()),
            "failures": failures,
            "kept_invalid_rows": int(self.kept_invalid.sum()),
        }


@dataclass
class ShardVerdict(JudgedRows):
    """Findings over the judged rows of one shard; ``rows`` (n,) are their places in the file.

    Attributes:
        metrics: deviations of stored metrics from recomputed numbers, absolute, (n,) each.
        self_pairs: pairs of links with self-penetration beyond the bound and their rows.
        claims: what the file says of itself.
    """

    metrics: dict[str, np.ndarray]
    self_pairs: Counter[str]
    notes: list[str]
    path: Path
    rows: np.ndarray
    claims: dict[str, str]

    def to_dict(self) -> dict[str, Any]:
        """Counts and failing checks."""
        told = {"claims": self.claims, "notes": self.notes}
        passing = {"kept_invalid_but_valid": int((self.kept_invalid & self.valid).sum())}
        return {"path": str(self.path), "total_rows": self.total_rows, **self.counts(), **passing, **told}


class Report(JudgedRows):
    """Findings over all judged rows of all shards; arrays are those of :class:`ShardVerdict` one after another.

    Attributes:
        shards: findings by shard.
        repeats: near-duplicates and distinct object poses, counted over all rows of the input, judged or not.
        seconds, seconds_load: time of the checks, and of reading and preparing hands and objects.
        rows: judged.
        valid_share: of the judged rows that the files do not call invalid themselves.
        left_out: why files in folders could not be judged, a line each.
        passed: whether there are such rows, all are strictly valid, and no file was left out.
        failures: rows failing each check; a row may fail several.
        self_pairs: pairs of links with self-penetration beyond the bound and their rows, most first.
        distributions: largest, 99th percentile and median of each recomputed number.
        metrics: those of the deviations of stored metrics from recomputed numbers.
    """

    def __init__(
        self,
        shards: Sequence[ShardVerdict],
        repeats: Repeats,
        seconds: float,
        seconds_load: float,
        left_out: Sequence[str] = (),
    ) -> None:
        self.shards, self.repeats, self.seconds, self.seconds_load = tuple(shards), repeats, seconds, seconds_load
        self.left_out = tuple(left_out)
        super().__init__(
            total_rows=sum(s.total_rows for s in shards),
            kept_invalid=np.concatenate([s.kept_invalid for s in shards]),
            values=_joined([s.values for s in shards]),
            failed=_joined([s.failed for s in shards]),
            held=np.concatenate([s.held for s in shards]),
        )
        claimed = ~self.kept_invalid
        self.rows = len(self.valid)
        self.valid_share = float(self.valid[claimed].mean()) if claimed.any() else 0.0
        self.passed = self.valid_share == 1.0 and not self.left_out
        self.failures = {k: int((v & claimed).sum()) for k, v in self.failed.items()}
        self.self_pairs = dict(sum((s.self_pairs for s in shards), Counter()).most_common())
        self.distributions = _spread(self.values)
        self.metrics = _spread(_joined([s.metrics for s in shards]))
        self.notes = list(dict.fromkeys(n for s in shards for n in s.notes))

    @property
    def by_objects(self) -> dict[int, dict[str, float]]:
        """By number of objects held: rows, valid ones, and the penetration of hand and objects [mm] of all."""
        out: dict[int, dict[str, float]] = {}
        for held in np.unique(self.held):
            mask = self.held == held
            out[int(held)] = {"rows": int(mask.sum()), "valid": int((mask & self.valid).sum())}
            for name, key in (("hand", "penetration_mm"), ("objects", "object_object_mm")):
                found = _spread({"": self.values[key][mask]}).get("", {})
                out[int(held)] |= {f"{name} {k}": found.get(k, math.nan) for k in ("max", "p50")}
        return out

    def to_dict(self) -> dict[str, Any]:
        """Everything but the rows' own numbers, fit for JSON; numbers that are not finite are None."""
        same = ("total_rows", "valid_share", "distributions", "by_objects", "notes", "seconds", "seconds_load")
        out = {
            **self.counts(),
            **{name: getattr(self, name) for name in same},
            "shards": [s.to_dict() for s in self.shards],
            "left_out": list(self.left_out),
            "stored_metrics": self.metrics,
            "near_duplicates": self.repeats.near,
            "near_duplicate_share": self.repeats.near / max(self.total_rows, 1),
            "distinct_object_poses": self.repeats.distinct_poses,
            "self_penetration_pairs": self.self_pairs,
        }
        return json.loads(json.dumps(out), parse_constant=lambda _: None)

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> Iterable[str]:
        places = _places([s.path for s in self.shards])
        width = max(5, *map(len, places))
        yield f"{'shard':<{width}}{'rows':>8}{'valid':>8}{'share':>10}  failing checks: rows (worst, bound)"
        for s, place in zip(self.shards, places, strict=True):
            d = s.to_dict()
            share = f"{100.0 * d['valid_rows'] / d['rows']:.2f} %" if d["rows"] else "-"
            line = f"{place:<{width}}{d['rows']:>8}{d['valid_rows']:>8}{share:>10}  "
            line += ", ".join(
                f"{check} {n['rows']}" + (f" ({n['worst']:.3g}, {n['bound']:.3g})" if "worst" in n else "")
                for check, n in d["failures"].items()
            )
            line += "" if d["failures"] else "none"
            line += f"; made for profile {s.claims['profile']}" if s.claims.get("profile", "strict") != "strict" else ""
            if d["kept_invalid_rows"]:
                line += f"; kept as invalid: {d['kept_invalid_rows']}, of which {d['kept_invalid_but_valid']} pass"
            yield line
        whole, repeats = self.counts(), self.repeats
        judged = f"{whole['valid_rows']} of {whole['rows']} judged rows ({100 * self.valid_share:.2f} %)"
        share = 100 * repeats.near / max(self.total_rows, 1)
        yield ""
        yield f"strictly valid   {judged}, {self.total_rows} rows in the input"
        yield f"near-duplicates  {repeats.near} ({share:.2f} %)"
        yield f"object poses     {repeats.distinct_poses} distinct"
        yield f"time             {self.seconds:.1f} s, reading and preparing {self.seconds_load:.1f} s"
        yield from _table("recomputed", self.distributions)
        yield from _table("stored metric, deviation", self.metrics)
        if set(self.by_objects) - {1}:
            yield from _table("objects held", {str(k): v for k, v in self.by_objects.items()})
        if self.self_pairs:
            yield "self-penetrating pairs: " + ", ".join(f"{k} {v}" for k, v in list(self.self_pairs.items())[:12])
        yield from (f"note: {note}" for note in self.notes)


def _places(paths: Sequence[Path]) -> list[str]:
    """The files, below their common folder."""
    files = [path.absolute() for path in paths]
    top = os.path.commonpath([file.parent for file in files])
    return [str(file.relative_to(top)) for file in files]


def _joined(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Arrays of one name, one after another."""
    names = dict.fromkeys(name for part in parts for name in part)
    return {name: np.concatenate([part[name] for part in parts if name in part]) for name in names}


def _spread(values: Mapping[str, np.ndarray]) -> dict[str, dict[str, float]]:
    finite = {k: v[np.isfinite(v)] for k, v in values.items()}
    shares = {"max": 1.0, "p99": 0.99, "p50": 0.5}
    return {k: {n: float(np.quantile(v, s)) for n, s in shares.items()} for k, v in finite.items() if len(v)}


def _table(head: str, rows: Mapping[str, Mapping[str, float]]) -> Iterable[str]:
    if rows:
        yield ""
        yield f"{head:<30}" + "".join(f"{name:>12}" for name in next(iter(rows.values())))
        yield from (f"{name:<30}" + "".join(f"{x:>12.4g}" for x in row.values()) for name, row in rows.items())
