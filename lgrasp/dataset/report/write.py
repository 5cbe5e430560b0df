"""Makes the report: shards in, one HTML file and the numbers out."""

import base64
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lgrasp.dataset.files import Paths
from lgrasp.dataset.info import SURVIVORS, asked_type, stage_counts, survivors
from lgrasp.dataset.merge import sum_statistics
from lgrasp.dataset.reader import ShardReader
from lgrasp.dataset.report.diversity import principal_postures
from lgrasp.dataset.report.gather import HandRows, ObjectRows
from lgrasp.dataset.report.page import page
from lgrasp.dataset.report.quantity import Distribution
from lgrasp.dataset.report.survey import Head, survey
from lgrasp.dataset.report.tables import Block
from lgrasp.dataset.report.verdicts import held_numbers
from lgrasp.dataset.scenes import SceneRows, draw_rows
from lgrasp.errors import LgraspError, OutputError
from lgrasp.files import write_file
from lgrasp.outputs import check_kind
from lgrasp.picture.sheet import image_bytes
from lgrasp.runtime.device import resolve_device

_PICTURES, _SIZE = 8, 160  # of a report, and pixels of a side


def report_dataset(paths: Paths, out: Path, *, progress: Callable[[int, int], None] | None = None) -> dict[str, Any]:
    """Write a report on a data set as one self-contained HTML file, without network.

    Args:
        paths: Shard files, or folders that hold some at any depth; of several hands and objects if need be.
        progress: Called with (rows done, rows in all) now and then.

    Returns:
        The numbers of the report, JSON-serialisable; docs/reference/metrics.md lists them.

    Raises:
        ShardError: No shard is found, or one cannot be read.
        OutputError: ``out`` cannot be written, or something else is there.
    """
    if out.exists() and not out.is_file():
        raise OutputError(f"report {out} cannot be written: it is no regular file; name another")
    check_kind(out, "HTML page", r"(<!--.*?-->\s*)?<(!doctype )?html")
    heads, remarks = survey(paths)
    numbers, hands = _read(heads, remarks, progress, near=True)
    write_file(out, page(numbers, hands, pictures(sorted(head.path for head in heads)) if numbers["rows"] else ()))
    return numbers


def pictures(paths: Paths, most: int = _PICTURES, columns: int = _PICTURES // 2) -> list[Block]:
    """Some rows, drawn side by side; a note if none can be."""
    try:
        rows = SceneRows(paths)
        chosen = rows.sound(rows.spread(most))
        image = draw_rows(rows, chosen, size=_SIZE, columns=columns)
    except LgraspError as error:  # what is reported need not be of a hand that can be drawn
        return [{"words": f"No pictures: {error}", "kind": "note"}]
    data = base64.b64encode(image_bytes(image, ".jpg")).decode()
    among = f"{len(chosen)} of {len(rows.chosen(())):,} rows"
    caption = f"{among}, evenly spread. Dots are contacts. More: lgrasp render, lgrasp view"
    return [{"jpeg": data, "caption": caption}]


def read_dataset(
    paths: Paths, *, progress: Callable[[int, int], None] | None = None, near: bool = True
) -> tuple[dict[str, Any], dict[tuple[str, str], HandRows]]:
    """The numbers of a report, and the data of its charts, by name and hash of the hands.

    Shards are read once, some thousand rows at a time; of the rows stay counts, an even sample of at most 50,000 per
    hand for the scatter plots, and poses and joints of one hand with one object at a time to find near-duplicates (some
    200 bytes a row, at most two million rows), on a GPU if there is one.

    Raises:
        ShardError: No shard is found, or one cannot be read.
    """
    return _read(*survey(paths), progress, near=near)


def _read(
    heads: Sequence[Head], remarks: Sequence[str], progress: Callable[[int, int], None] | None, *, near: bool
) -> tuple[dict[str, Any], dict[tuple[str, str], HandRows]]:
    total, done, device = sum(head.rows for head in heads), 0, resolve_device().alias if near else None
    hands: dict[tuple[str, str], HandRows] = {}
    before = None

    def advanced(rows: int) -> None:
        if progress:
            progress(done + rows, total)

    for head in heads:
        with ShardReader(head.path, invalid=False) as reader:
            if head.hand not in hands:
                locked = head.header.config.get("locked")
                hands[head.hand] = HandRows(reader.hand(), device, locked if isinstance(locked, dict) else ())
            if before is not None and (head.hand, head.labels) != (before.hand, before.labels):
                hands[before.hand].close()
            hands[head.hand].add(reader, head.labels, advanced)
        before = head
        done += head.rows
    summary = {
        "shards": len(heads),
        "rows": total,
        "bytes": sum(head.bytes for head in heads),
        "remarks": remarks,
        "hands": [_hand(key, rows, [h for h in heads if h.hand == key]) for key, rows in hands.items()],
    }
    return summary, hands


def _hand(key: tuple[str, str], hand: HandRows, heads: list[Head]) -> dict[str, Any]:
    contacts, pipelines = int(hand.links.sum()), sorted({h.header.pipeline for h in heads})
    shares = {name: int(n) / contacts for name, n in zip(hand.hand.link_names, hand.links, strict=True) if n}
    return {
        "hand": key[0],
        "sha256": key[1],
        "joints": list(hand.hand.joint_names),
        "rows": hand.rows,
        "shards": len(heads),
        "created": [min(h.header.created for h in heads), max(h.header.created for h in heads)],
        "lgrasp_versions": sorted({h.header.lgrasp_version for h in heads}),
        "runs": [_run(name, [h for h in heads if h.header.pipeline == name]) for name in pipelines],
        "grasp_types": _types(heads),
        "metrics": _metrics(hand.together()),
        "objects": [_objects(group) for group in hand.objects.values()],
        "diversity": hand.spread().numbers(),
        "held": held_numbers(hand.held),
        "contact_links": dict(sorted(shares.items(), key=lambda item: -item[1])),
        "posture": principal_postures(hand.rows, hand.sum_q, hand.sum_qq).numbers(),
        "sample": {"rows": len(hand.sample.columns().get("group", ())), "every": hand.sample.step},
    }


def _types(heads: Sequence[Head]) -> dict[str, int]:
    """Rows by the grasp type that their shard was asked for; "" for those asked for none; empty if none was for one."""
    counts: Counter[str] = Counter()
    for head in heads:
        counts[asked_type(head.header.config) or ""] += head.rows
    return dict(sorted(counts.items())) if set(counts) - {""} else {}


def _metrics(distributions: Mapping[str, Distribution]) -> dict[str, Any]:
    return {name: found.numbers() for name, found in distributions.items() if found.rows}


def _run(pipeline: str, heads: Sequence[Head]) -> dict[str, Any]:
    """What one pipeline counted on its way, over all shards."""
    statistics = sum_statistics([head.statistics for head in heads])
    counts = stage_counts(statistics)
    seconds = {name.removeprefix("seconds_"): v for name, v in statistics.items() if name.startswith("seconds_")}
    return {
        "pipeline": pipeline,
        "rows": sum(head.rows for head in heads),
        "seeds": sorted({head.header.seed for head in heads}),
        "device": str(statistics.get("device", "")),
        "survivors": survivors({stage: counts[stage] for stage in heads[0].stages or SURVIVORS if stage in counts}),
        "counts": counts,
        "seconds": {name: float(value) for name, value in seconds.items() if not isinstance(value, str)},
    }


def _objects(group: ObjectRows) -> dict[str, Any]:
    near = group.near
    return {
        "objects": list(group.names),
        "rows": group.rows,
        "metrics": _metrics(group.quantities),
        "contacts": {str(n): rows for n, rows in sorted(group.contacts.items())},
        "distinct_poses": near.poses,
        "near_duplicates": {
            "compared": near.compared,
            "duplicates": near.duplicates,
            "share": near.duplicates / near.compared if near.compared else 0.0,
        },
        "coverage": {
            name: coverage.numbers(near.poses) | {"surface": group.touched[name].numbers()}
            for name, coverage in group.coverage.items()
        },
        "diversity": {name: spread.numbers() for name, spread in group.spread.items()},
        "physics": {name: verdicts.numbers() for name, verdicts in group.verdicts.items()},
    }
