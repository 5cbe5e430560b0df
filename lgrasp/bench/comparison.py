"""Hands x objects, pipelines in turn in one run on one device, compared with published figures if there are any."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import fmean
from typing import Any

import lgrasp
from lgrasp.bench.page import Page, Published, caveats, check_once, over, times
from lgrasp.bench.page import Table as Texts
from lgrasp.bench.rate import measure
from lgrasp.engine.cache import Cache
from lgrasp.errors import ConfigError, LgraspError, ObjectError
from lgrasp.files import temporary_folder
from lgrasp.hand.names import all_hands
from lgrasp.jobs.config import JobConfig, config_objects, in_folder, plan_requests
from lgrasp.object.find import find_object
from lgrasp.runtime.device import resolve_device
from lgrasp.words import number

Table = dict[str, Any]
Cell = dict[str, Any]


def new_table(config: JobConfig, *, repeat: int, baseline_rows: int, published: Published | None = None) -> Table:
    """A table without cells: the plan of the measurement. The last of several pipelines is the baseline.

    Returns:
        ``settings`` (two tables can be joined if theirs agree), ``hands``, ``objects``, ``published``, ``complete``,
        ``cells`` and ``means`` (both still empty).

    Raises:
        ConfigError: two hands, objects or pipelines of one name.
        DeviceError: the device does not exist.
    """
    asked = {"pipelines": config.pipelines, "hands": all_hands(config.hands), "objects": config_objects(config)}
    named = {kind: [Path(name).stem for name in names] for kind, names in asked.items()}
    for kind, names in named.items():
        check_once(kind[:-1], names)
    settings = {
        "lgrasp": lgrasp.__version__,
        "device": resolve_device(config.device).name,
        "pipelines": named["pipelines"],
        "baseline_rows": baseline_rows,
        "repeat": repeat,
        "set": list(config.settings),
        **config.model_dump(mode="json", include={"rows", "shard_rows", "seed", "workers", "hand_dir", "object_dir"}),
    }
    return {
        "settings": settings,
        "hands": named["hands"],
        "objects": named["objects"],
        "published": published and published.model_dump(mode="json"),
        "cells": [],
        "means": [],
        "complete": False,
    }


def without_missing(config: JobConfig) -> tuple[JobConfig, list[str]]:
    """The config with the objects that are here, and the names of those that are not."""
    missing = []
    for mesh in config.objects:
        try:
            find_object(in_folder(config.object_dir, mesh))
        except ObjectError:
            missing.append(mesh)
    kept = tuple(mesh for mesh in config.objects if mesh not in missing)
    return config.model_copy(update={"objects": kept}) if kept else config, missing


def read_table(path: Path, wanted: Table) -> Table:
    """The table that is wanted, with the cells that an earlier run of the same settings left in a file.

    Raises:
        ConfigError: the file is no such table, or one of other settings.
    """
    if not path.exists():
        return wanted
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        was = _plan(found)
        cells = [cell for cell in found["cells"] if not cell["error"]]
    except (OSError, ValueError, TypeError, KeyError):
        raise ConfigError(f"--resume: {path} is no table of lgrasp bench table1; remove it or name another") from None
    for name, value in _plan(wanted).items():
        if was.get(name) != value:
            raise ConfigError(
                f"--resume: {path} was measured with {name} {was.get(name)}, not {value}; name another file"
            )
    return with_ratios(wanted | {"cells": cells})


def _plan(table: Table) -> dict[str, Any]:
    return table["settings"] | {"hands": table["hands"], "objects": table["objects"]}


def measure_table(
    table: Table, config: JobConfig, cache: Cache, *, progress: Callable[[str], None] = lambda line: None
) -> Iterator[tuple[Table, Cell]]:
    """Measure the cells that a table lacks; the table so far and its newest cell come back after each.

    A cell is one hand and one object: all pipelines in turn, ``repeat`` times, the baseline with ``baseline_rows``
    rows. A cell that cannot be measured says why in ``error`` and does not stop the others. Nothing is left behind.

    Raises:
        ConfigError: see :func:`plan_requests`.
    """
    settings, jobs = table["settings"], [request.job(cache) for request in plan_requests(config)]
    jobs = [job.changed(pipeline=job.pipeline.impatient()) for job in jobs]
    # plan_requests: pipeline, hand, object; here all pipelines of a hand and object go together
    pairs = [(hand, mesh) for hand in table["hands"] for mesh in table["objects"]]
    done = {(cell["hand"], cell["object"]) for cell in table["cells"]}
    with temporary_folder() as folder:
        own, built = Cache(folder), {}
        for first, (hand, mesh) in enumerate(pairs):
            if (hand, mesh) in done:
                continue
            ours = jobs[first :: len(pairs)]
            if len(ours) > 1:
                ours[-1] = ours[-1].changed(rows=settings["baseline_rows"])
            runs, error = [], ""
            try:
                runs = measure(ours, settings["repeat"], own, built, progress)
            except LgraspError as problem:
                error = str(problem)
            cell = {
                "hand": hand,
                "object": mesh,
                "hand_from": ours[0].hand,
                "object_from": ours[0].object,
                "asked": {name: job.rows for name, job in zip(settings["pipelines"], ours, strict=True)},
                "error": error,
                "pipelines": dict(zip(settings["pipelines"], runs, strict=False)),
            }
            table = with_ratios(table | {"cells": [*table["cells"], cell]})
            yield table, cell


def with_ratios(table: Table) -> Table:
    """The table with the ratios of its cells, the means of its hands and whether it is complete."""
    names, hands, objects = table["settings"]["pipelines"], table["hands"], table["objects"]
    published = (table["published"] or {}).get("figures", {})
    cells = []
    for cell in sorted(table["cells"], key=lambda c: (hands.index(c["hand"]), objects.index(c["object"]))):
        figure = published.get(cell["hand"], {}).get(cell["object"])
        rates = {name: _rate(cell, name) for name in cell["pipelines"]}
        cells.append(cell | {"published_per_s": figure} | _ratios(names, rates, figure))
    means = []
    for hand in hands:
        if own := _measured(cells, hand):
            rates = {name: trimmed_mean([_rate(cell, name) for cell in own]) for name in names}
            figures = [cell["published_per_s"] for cell in own]
            figure = None if None in figures else trimmed_mean(figures)  # over the same cells, if it has all of them
            mean = {"hand": hand, "cells": len(own), "strict_valid_per_s": rates, "published_per_s": figure}
            means.append(mean | _ratios(names, rates, figure))
    return table | {"cells": cells, "means": means, "complete": len(cells) == len(hands) * len(objects)}


def _measured(cells: list[Cell], hand: str) -> list[Cell]:
    return [cell for cell in cells if cell["hand"] == hand and not cell["error"]]


def _ratios(names: list[str], rates: dict[str, float], figure: float | None) -> dict[str, Any]:
    """Each pipeline over the baseline and over the published figure; None where there is nothing."""
    return {
        "ratio": {name: over(rates.get(name), rates.get(names[-1])) for name in names[:-1]},
        "published_ratio": {name: over(rates.get(name), figure) for name in names},
    }


def _rate(cell: Cell, name: str) -> float:
    return cell["pipelines"][name]["strict_valid_per_s"]["median"]


def trimmed_mean(values: list[float]) -> float:
    """Mean without the highest and the lowest of three or more values; of fewer, the mean."""
    return fmean(sorted(values)[1:-1] if len(values) > 2 else values)


def cell_line(table: Table, cell: Cell) -> str:
    """The result of the newest cell, in one line."""
    total = len(table["hands"]) * len(table["objects"])
    rates = ", ".join(f"{name} {number(_rate(cell, name))}/s" for name in cell["pipelines"])
    return f"[{len(table['cells'])}/{total}] {cell['hand']} {cell['object']}: {cell['error'] or rates}"


def comparison_page(table: Table) -> Page:
    """A table as texts: rates with ratios for each hand, then details."""
    settings, published = table["settings"], table["published"]
    names = settings["pipelines"]
    baseline = f", {names[-1]} {settings['baseline_rows']:,}" if len(names) > 1 else ""
    what = f"strict-valid grasps per second, median of {settings['repeat']}"
    notes = ["trimmed mean: without the highest and the lowest object"] if len(table["objects"]) > 2 else []
    notes.append(
        "thread-seconds by stage; object s, field s: made from nothing, not part of the rates; load s: from the cache"
    )
    lost = [cell for cell in table["cells"] if cell["error"]]
    notes += [f"{cell['hand']} {cell['object']} could not be measured: {cell['error']}" for cell in lost]
    tables = [part for hand in table["hands"] for part in _hand_tables(table, hand)]
    head = f"{settings['device']}: {settings['rows']:,} grasps{baseline}; {what}"
    return Page([head], tables, notes + (caveats(published) if published else []))


def _hand_tables(table: Table, hand: str) -> list[Texts]:
    names, published = table["settings"]["pipelines"], table["published"]
    cells = _measured(table["cells"], hand)
    if not cells:
        return []
    source = cells[0]["hand_from"]
    columns = ("object", *(f"{n}/s" for n in names), *(f"{n}/{names[-1]}" for n in names[:-1]))
    if published:
        columns = (*columns, "published/s", *(f"{n}/published" for n in names))
    rows = [_rates(cell["object"], {n: _rate(cell, n) for n in names}, cell, published) for cell in cells]
    if len(cells) > 1:
        mean = next(mean for mean in table["means"] if mean["hand"] == hand)
        rows.append(_rates("trimmed mean" if len(cells) > 2 else "mean", mean["strict_valid_per_s"], mean, published))
    runs = [(cell["object"], name, cell["pipelines"][name]) for cell in cells for name in names]
    stages = sorted({stage for *_, run in runs for stage in run["counts"]})
    details = [{"object": mesh, "pipeline": name} | _rows(run) for mesh, name, run in runs]
    seconds = [{"object": mesh, "pipeline": name} | _seconds(run, stages) for mesh, name, run in runs]
    return [
        Texts(hand + (f" ({source})" if source != hand else ""), columns, rows),
        *(Texts("", tuple(part[0]), [tuple(row.values()) for row in part], 2) for part in (details, seconds)),
    ]


def _rates(what: str, rates: dict[str, float], of: dict[str, Any], published: Any) -> tuple[str, ...]:
    texts = (what, *(number(rate) for rate in rates.values()), *map(times, of["ratio"].values()))
    return (*texts, number(of["published_per_s"]), *map(times, of["published_ratio"].values())) if published else texts


def _rows(run: dict[str, Any]) -> dict[str, str]:
    """What came out of a run, by column."""
    strict = run["strict_valid_per_s"]
    return {
        "grasps": number(run["grasps"]) + (" starved" if run["starved"] else ""),
        "strict": number(run["strict"]),
        "range/s": f"{strict['min']:,.0f}-{strict['max']:,.0f}",
        "published count/s": number(run["published_count_per_s"]["median"]),
        "near-dup": number(run["near_duplicates"]),
        "poses": number(run["distinct_poses"]),
        "survivors": "  ".join(f"{stage} {count:,}" for stage, count in run["survivors"].items()),
    }


def _seconds(run: dict[str, Any], stages: list[str]) -> dict[str, str]:
    """What a run took, by column."""
    parts = {stage: run["seconds"].get(stage, 0.0) for stage in stages} | {"wall s": run["seconds"]["wall"]}
    parts |= {f"{what} s": run["build_seconds"][what] for what in ("object", "field")}
    parts["load s"] = sum(run["load_seconds"].values())
    return {name: f"{x:.2f}" for name, x in parts.items()} | {"MB": number(run["peak_rss_mb"])}
