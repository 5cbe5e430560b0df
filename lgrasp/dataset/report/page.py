"""The report as one HTML page: charts inline, no script, no other file."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import jinja2

from lgrasp.dataset.report.diversity import principal_postures
from lgrasp.dataset.report.gather import HandRows
from lgrasp.dataset.report.plots import (
    MAPS,
    contact_chart,
    direction_maps,
    failure_chart,
    position_chart,
    posture_chart,
    quantity_chart,
)
from lgrasp.dataset.report.tables import (
    Block,
    diversity_table,
    held_tables,
    physics_table,
    protocol_list,
    run_tables,
    validity_table,
)
from lgrasp.dataset.report.verdicts import passed_words
from lgrasp.words import number, plural


def page(numbers: dict[str, Any], hands: Mapping[tuple[str, str], HandRows], pictures: Sequence[Block] = ()) -> str:
    """The page of the numbers of a report, and of the hands that they were made of, for the samples."""
    objects = [" + ".join(group["objects"]) for hand in numbers["hands"] for group in hand["objects"]]
    names = [hand["hand"] for hand in numbers["hands"]]
    what = names[0] if len(names) == 1 else f"{len(names)} hands"
    whole = objects[0] if len(names) == len(objects) == 1 else plural(len(objects), "object")
    title = f"Grasps: {number(numbers['rows'])} of {what} with {whole}"
    blocks = [*_head(numbers), *pictures]
    for data, rows in zip(numbers["hands"], hands.values(), strict=True):
        blocks += _hand(data, rows)
    return render_page(title, blocks)


def render_page(title: str, blocks: Sequence[Block]) -> str:
    """Blocks as one HTML page that needs nothing else."""
    loader = jinja2.PackageLoader("lgrasp.dataset.report", ".")
    pages = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return pages.get_template("page.html").render(title=title, blocks=blocks)


def chapter(heading: str, level: int = 3) -> Block:
    """A heading."""
    return {"heading": heading, "level": level}


def _figure(svg: str, caption: str = "") -> Block:
    return {"svg": svg, "caption": caption}


def _groups(groups: list[dict[str, Any]]) -> str:
    if any(len(group["objects"]) > 1 for group in groups):
        return "sets of objects in a hand"
    return "pairs of hand and object" if len(groups) != 1 else "object"


def _head(numbers: dict[str, Any]) -> list[Block]:
    groups = [group for hand in numbers["hands"] for group in hand["objects"]]
    compared = sum(group["near_duplicates"]["compared"] for group in groups)
    near = sum(group["near_duplicates"]["duplicates"] for group in groups)
    over = sum(m["over_bound"] or 0 for group in groups for m in group["metrics"].values())
    shown = [
        (number(numbers["rows"]), "grasps"),
        (number(len(numbers["hands"])), "hands" if len(numbers["hands"]) != 1 else "hand"),
        (number(len(groups)), _groups(groups)),
        (number(numbers["shards"]), f"shards, {numbers['bytes'] / 1e6:,.1f} MB"),
        (number(over), "values above a strict bound"),
        (f"{near / compared:.2%}" if compared else "-", "near-duplicates"),
        (number(sum(group["distinct_poses"] for group in groups)), "distinct object poses"),
    ]
    for name in sorted({name for group in groups for name in group["physics"]}):
        found = [group["physics"][name] for group in groups if name in group["physics"]]
        run = sum(f["run"] for f in found)
        if run:
            shown.append((f"{sum(f['held'] for f in found) / run:.1%}", passed_words(name)))
    lead = "Numbers are those stored in the shards; near-duplicates, poses and coverage are computed from the rows."
    remarks = [{"words": line, "kind": "note"} for line in numbers["remarks"]]
    return [{"words": lead, "kind": "dim"}, *remarks, {"tiles": shown}]


def _hand(data: dict[str, Any], hand: HandRows) -> list[Block]:
    parts = [chapter(data["hand"], 2), *run_tables(data)]
    if not data["rows"]:
        return [*parts, {"words": "No rows."}]
    held = held_tables(data)
    contacts: Counter[int] = Counter()
    for group in data["objects"]:
        contacts.update({int(n): rows for n, rows in group["contacts"].items()})
    return [
        *(*parts, chapter("Validity"), validity_table(data), *_histograms(hand)),
        *((chapter("Objects in the hand"), *held) if held else ()),
        *(_physics(data) if any(group["physics"] for group in data["objects"]) else ()),
        *(chapter("Contacts"), _figure(contact_chart(contacts, data["contact_links"]))),
        *(chapter("Diversity"), diversity_table(data)),
        *_dots(data, hand),
    ]


def _histograms(hand: HandRows) -> list[Block]:
    together = [d for d in hand.together().values() if d.rows]
    bounded = [d for d in together if d.quantity.bound is not None]
    free = [d for d in together if d.quantity.bound is None]
    out = []
    if bounded:
        text = "Orange: the strict bound. The last bar holds what lies beyond."
        out.append(_figure(quantity_chart(bounded), text))
    if free:
        text = (
            "Epsilon and volume as docs/reference/metrics.md defines them: friction 0.5, eight-edge cones, torque over "
            "the object's radius. 0: the origin is not inside the hull, so some load cannot be held at this friction."
        )
        out += [chapter("Quality"), _figure(quantity_chart(free), text)]
    return out


def _physics(data: dict[str, Any]) -> list[Block]:
    total: dict[str, dict[str, Counter[str]]] = {}
    for group in data["objects"]:
        for name, verdicts in group["physics"].items():
            for way, counts in verdicts["directions"].items():
                total.setdefault(name, {}).setdefault(way, Counter()).update(counts)
    tried = [(name, ways) for name, ways in total.items() if any(way["run"] for way in ways.values())]
    text = "Of the grasps run in a direction; a grasp that failed in one may not have been run in the others."
    chart = [_figure(failure_chart(tried), text)] if tried else []
    return [chapter("Physics"), physics_table(data), *chart, *protocol_list(data)]


def _dots(data: dict[str, Any], hand: HandRows) -> list[Block]:
    """Where objects are, from where hands come, and the postures: charts of the sampled rows."""
    sample, middles, names = hand.sample.columns(), hand.middles.columns(), [" + ".join(n) for n in hand.objects]
    dots = _sampled(data["sample"]["rows"], data["sample"]["every"], data["rows"], "grasps")
    held = sum(group.rows * len(group.coverage) for group in hand.objects.values())
    where = "Middle of the object's bounding box in the frame of the hand's base (+: its origin). " + _sampled(
        len(middles["name"]), hand.middles.step, held, "grasps" if held == data["rows"] else "objects in grasps"
    )
    maps = hand.directions()
    ways = (
        "Direction from the object's middle to the origin of the hand's base, in the object's frame: where the hand "
        "stands around the object. Equal-area map: +x in the middle, +y a quarter turn to the right, +z on top, -x at "
        "both ends; bins without colour are empty."
    )
    if len(maps) > MAPS:
        ways += f" The first {MAPS} of {len(maps)} objects."
    posture, found = principal_postures(hand.rows, hand.sum_q, hand.sum_qq), data["posture"]
    postures = (
        f"Principal components of the {len(data['joints'])} joint positions. Effective dimension "
        f"{found['effective_dimension']:.1f} (squared sum of the variances over the sum of their squares); "
        f"{found['components_for_95_percent']} components explain 95 %. {dots}"
    )
    return [
        chapter("Object positions"),
        _figure(position_chart(middles["position"], middles["name"], hand.names), where),
        *(chapter("Approach directions"), _figure(direction_maps(maps), ways)),
        chapter("Postures"),
        _figure(posture_chart(posture, posture.scores(sample["q"]), sample["group"], names), postures),
    ]


def _sampled(shown: int, every: int, rows: int, what: str) -> str:
    return f"Dots: {number(shown)} of {number(rows)} {what}" + (f", one in {every}." if every > 1 else ".")
