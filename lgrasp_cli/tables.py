"""Tables on standard output: aligned columns, the same on a terminal and in a file."""

import json
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import typer


def print_json(data: Any) -> None:
    """JSON on standard output."""
    typer.echo(json.dumps(data, indent=2))


def print_report(data: Any, json_path: str | None, show: Callable[[], None] | None) -> None:
    """A report as --json says: to standard output for -, else shown, and written to the path if there is one.

    Args:
        show: prints the tables; None: nothing is to be shown.
    """
    if json_path == "-":
        print_json(data)
        return
    if show:
        show()
    if json_path:
        from lgrasp.engine.report import write_json

        write_json(json_path, data)


def print_pairs(pairs: Iterable[tuple[str, str]]) -> None:
    """Two columns: label, value."""
    _print_rows([list(pair) for pair in pairs], ())


def print_table(columns: Sequence[str], rows: Iterable[Sequence[str]], right: Sequence[str] = ()) -> None:
    """A table with a header line.

    Args:
        right: columns of numbers.
    """
    _print_rows([list(columns), *(list(row) for row in rows)], [i for i, name in enumerate(columns) if name in right])


def _print_rows(rows: list[list[str]], right: Sequence[int]) -> None:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = [c.rjust(w) if i in right else c.ljust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))]
        typer.echo("  ".join(cells).rstrip())


def counted(data: dict[str, Any], unit: str) -> str:
    """How much of the requested amount exists."""
    extra = f" ({data['present']:,} already present)" if data["present"] else ""
    return f"{data[unit]:,} of {data['asked']:,} requested{extra}"


def job_report(data: dict[str, Any]) -> list[tuple[str, str]]:
    """The report of a job as pairs of texts."""
    seconds, made = data["seconds"], data["made"]
    stages = list(data["counts"])
    pairs = [
        ("grasps", counted(data, "grasps")),
        ("where", f"{data['out']} ({len(data['shards'])} shard{'s' if len(data['shards']) != 1 else ''})"),
        ("hand, object", f"{data['hand']}, {data['object']}; pipeline {data['pipeline']}, seed {data['seed']}"),
        ("wall", f"{seconds['total']:.2f} s, {seconds['wall']:.2f} s of it from placement through filter"),
    ]
    if made:
        pairs += [("strict-valid", f"{data['strict_valid_per_s']:,.0f} /s ({data['strict']:,})")]
        if data["strict"] < data["grasps"]:
            pairs += [("by own bounds", f"{data['grasps_per_s']:,.0f} /s ({data['grasps']:,})")]
        pairs += [
            ("published count", f"{data['published_count_per_s']:,.0f} /s ({data['published_count']:,})"),
        ]
    pairs += [
        ("survivors", "  ".join(f"{name} {data['survivors'][name]:,}" for name in stages)),
        ("thread-seconds", "  ".join(f"{name} {seconds[name]:.2f}" for name in stages)),
        ("loading", "  ".join(f"{n} {seconds[n]:.2f} s" for n in ("hand", "object", "field", "kernels"))),
        ("near-duplicates", f"{data['near_duplicates']:,}"),
        ("distinct poses", f"{data['distinct_poses']:,}"),
        (
            "peak memory",
            f"{data['peak_rss_mb']:,.0f} MB"
            + (f", device {data['peak_device_mb']:,.0f} MB" if data["peak_device_mb"] else ""),
        ),
        ("device", data["device"]),
    ]
    return pairs
