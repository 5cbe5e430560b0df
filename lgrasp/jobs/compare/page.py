"""A comparison of hands as one HTML page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lgrasp.dataset.report.page import chapter, render_page
from lgrasp.dataset.report.tables import Block, table
from lgrasp.dataset.report.write import pictures
from lgrasp.files import write_file
from lgrasp.jobs.compare.measure import MEANS
from lgrasp.jobs.hands import types_text
from lgrasp.words import number

COLUMNS = (  # number, head, factor, format
    ("rows", "rows", 1, ",.0f"),
    ("yield", "rows/pose", 1, ".3f"),
    ("strict_per_s", "rows/s", 1, ",.0f"),
    ("approach", "approach [%]", 100, ".0f"),
    ("surface", "surface [%]", 100, ".0f"),
    ("pca_ratio", "PCA 1 [%]", 100, ".0f"),
    ("joint_entropy", "entropy", 1, ".2f"),
    ("contacts", "contacts", 1, ".1f"),
    ("epsilon", "epsilon", 1, ".3f"),
    ("hold", "hold [%]", 100, ".0f"),
    ("simulated", "simulated [%]", 100, ".0f"),
)
HAND_COLUMNS = (
    ("volume", "space [cm3]", 1e6, ",.0f"),
    ("shared", "shared [cm3]", 1e6, ",.0f"),
    ("manipulability", "manip. [cm3]", 1e6, ",.0f"),
    ("types", "types", 1, ",.0f"),
)
"""Numbers of a hand alone."""

WITHOUT_ROWS = "contacts, epsilon, hold and simulated leave out objects without a grasp"


def cells(found: Mapping[str, Any], columns: Sequence[tuple[str, str, float, str]]) -> list[str]:
    """Numbers as texts, ``-`` for None; of a PCA ratio the first, of an entropy the mean."""
    texts = []
    for name, _, factor, style in columns:
        value = found[name]
        if isinstance(value, Mapping):
            value = value["mean"]
        elif isinstance(value, Sequence):
            value = value[0]
        texts.append(number(None if value is None else factor * value, style))
    return texts


def hand_cells(hand: Mapping[str, Any]) -> list[str]:
    """Numbers of a hand alone as texts: HAND_COLUMNS; of grasp types those that differ in contacts."""
    return cells({**hand["workspace"], "types": len(hand["grasp_types"])}, HAND_COLUMNS)


def shown_columns(hands: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, float, str]]:
    """Those of which there is a number."""
    return [column for column in COLUMNS if any(hand["all"][column[0]] is not None for hand in hands)]


def write_page(data: Mapping[str, Any], files: Mapping[str, Sequence[Path]], out: Path) -> None:
    """Write the page of the report of a comparison.

    Args:
        data: see :meth:`lgrasp.jobs.compare.job.CompareJob.report`.
        files: shards by hand.

    Raises:
        OutputError: the page cannot be written.
    """
    hands, columns = data["hands"], shown_columns(data["hands"])
    heads = [head for _, head, _, _ in columns]
    alone = [head for _, head, _, _ in HAND_COLUMNS]
    rows = [[h["hand"], *cells(h["all"], columns), *hand_cells(h)] for h in hands]
    words = (
        f"Pipeline {data['pipeline']}, at most {data['asked_rows']:,} grasps of each hand with each object, "
        f"on {data['device']}. Means over the objects; rows, PCA and entropy of all together; {WITHOUT_ROWS}. "
    )
    words += "; ".join(f"{head}: {MEANS[name]}" for name, head, _, _ in columns if name in MEANS)
    blocks: list[Block] = [
        {"words": f"{words}. docs/guides/compare-hands.md explains the rest.", "kind": "dim"},
        chapter("All objects", 2),
        table(["hand", *heads, *alone], rows),
        chapter("By object", 2),
    ]
    for name in dict.fromkeys(name for hand in hands for name in hand["objects"]):
        found = [[h["hand"], *cells(h["objects"][name], columns)] for h in hands if name in h["objects"]]
        blocks += [chapter(name), table(["hand", *heads], found)]
    blocks += [
        chapter("Grasp types", 2),
        table(
            ["hand", "types; those joined by = ask for the same contacts"],
            [[hand["hand"], types_text(hand["grasp_types"])] for hand in hands],
        ),
    ]
    blocks.append(chapter("Pictures", 2))
    for hand in hands:
        drawn = (
            pictures(files[hand["hand"]], 4, 4) if hand["all"]["rows"] else [{"words": "No grasps.", "kind": "note"}]
        )
        blocks += [chapter(hand["hand"]), *drawn]
    write_file(out, render_page(f"Hands compared: {', '.join(hand['hand'] for hand in hands)}", blocks))
