"""Survivors of stages, in one number each, from the counts in shards."""

from collections.abc import Mapping
from typing import Any

Counts = dict[str, dict[str, int]]
"""Stage -> what is counted -> number."""

SURVIVORS = {
    "place": "kept",
    "domain": "rich",
    "ik": "kept",
    "search": "sets",
    "filter": "kept",
    "refine": "tried",
    "sequence": "kept",
    "simulate": "held",
}
"""The count of a stage that says how many came through."""

_OLD_NAMES = {"validate": "simulate"}
"""Stages as shards of 0.1 name them."""


def survivors(counts: Counts) -> dict[str, int]:
    """One number per stage: poses, poses in reach, realised contacts (or sets), sets, grasps."""
    return {
        stage: found.get("sets" if stage == "ik" and "sets" in found else SURVIVORS[stage], 0)
        for stage, found in counts.items()
    }


def stage_counts(statistics: Mapping[str, Any]) -> Counts:
    """Counts by stage from the statistics of a shard (``STAGE_NAME``)."""
    counts: Counts = {}
    for key, value in statistics.items():
        stage, _, name = key.partition("_")
        stage = _OLD_NAMES.get(stage, stage)
        if stage in SURVIVORS and isinstance(value, int):
            counts.setdefault(stage, {})[name.replace("_", " ")] = value
    return counts
