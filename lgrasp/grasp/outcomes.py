"""Outcomes of checked grasps, and the numbers kept of them."""

from enum import IntEnum
from typing import Any

import numpy as np
import warp as wp

from lgrasp.grasp.bounds import ANY_CLOSING, ANY_PENETRATION, ANY_SWEEP, GraspBounds
from lgrasp.grasp.tables import GraspTable


class Outcome(IntEnum):
    """The first check that a row failed."""

    KEPT = 0
    UNUSED_FINGER = 1
    SELF_COLLISION = 2
    OBJECT_COLLISION = 3
    CONTACT = 4
    BALANCE = 5
    UNRESISTED_LOAD = 6
    TABLE = 7
    APPROACH = 8
    SQUEEZE = 9
    WEAK = 10
    TOUCH = 11
    HOLD = 12


PINCH = wp.constant(2)
"""Contacts of a grasp that bounds.min_stable_pinch is for."""

REASONS = (
    *("kept", "unused finger", "self-collision", "object collision", "contact", "balance", "unresisted load"),
    *("table", "approach", "squeeze", "weak"),
)
"""Outcomes in words, by code; ``weak``: effort limits leave too little squeeze. Where a share of the force must be on a
region there is one more, SHARED."""

SHARED = (*REASONS, "touch")

LATE = ("kept", "approach", "squeeze", "weak", "touch")
"""Outcomes in words of what is found once rows are packed."""

NOT_HELD = "not held"
"""Outcome HOLD in words, of plans alone."""

FAILED_BOUNDS = (
    *("none", "min_contacts", "max_gap", "max_normal_angle", "min_self_distance", "max_penetration", "max_gswo"),
    *("max_unresisted_load", "min_table_distance", "approach", "min_squeeze_travel", "min_stable_squeeze"),
    *("max_closing_travel", "min_epsilon", "min_pregrasp_opening", "min_hold_probability"),
    *("max_closing_penetration", "max_closing_sweep", "min_force_share", "steered"),
)
"""By code, the first bound that a row fails, of :class:`~lgrasp.grasp.bounds.GraspBounds`; ``approach``: no straight
way of the open hand to the object clears the table; ``steered``: it touches otherwise than is asked."""

_FAILED = {
    Outcome.SELF_COLLISION: "min_self_distance",
    Outcome.OBJECT_COLLISION: "max_penetration",
    Outcome.BALANCE: "max_gswo",
    Outcome.UNRESISTED_LOAD: "max_unresisted_load",
    Outcome.TABLE: "min_table_distance",
    Outcome.APPROACH: "approach",
    Outcome.TOUCH: "steered",
    Outcome.HOLD: "min_hold_probability",
}

MEASURED = ("gap", "facing", "fswo", "gswo", "unresisted_load", "penetration")
"""Rows of the numbers that the checks leave on the device; ``facing`` is the least cosine of opposed normals."""

METRICS = (
    *("fswo", "gswo", "unresisted_load", "epsilon", "force_closure"),
    *("penetration", "self_penetration", "gap", "normal_error", "pregrasp_opening", "squeeze_travel"),
    *("squeeze_force", "stable_squeeze", "closing_travel", "closing_penetration", "closing_sweep"),
)
"""Columns of the metrics table."""


_SQUEEZE_BOUNDS = (
    *("min_squeeze_travel", "max_closing_travel", "min_stable_squeeze", "min_epsilon", "min_pregrasp_opening"),
    *("max_closing_penetration", "max_closing_sweep", "min_force_share"),
)


def bounds_squeeze(bounds: Any) -> bool:
    """Whether one of _SQUEEZE_BOUNDS asks for something; ``bounds`` as of :func:`failed_squeeze`."""
    least = [bounds.min_squeeze_travel, bounds.min_epsilon, bounds.min_pregrasp_opening]
    least += [bounds.min_stable_squeeze, bounds.min_stable_pinch, bounds.min_force_share]
    through = bounds.max_closing_penetration < ANY_PENETRATION or bounds.max_closing_sweep < ANY_SWEEP
    return max(least) > 0 or bounds.max_closing_travel < ANY_CLOSING or through


def failed_squeeze(table: GraspTable, bounds: Any) -> list[np.ndarray]:
    """Which of n rows fail each of _SQUEEZE_BOUNDS (GraspBounds, or the same numbers on a device), (n,) bool, in its
    order."""
    touching = table.contact_links >= 0
    pinch = touching.sum(1) == int(PINCH)
    push = -(table.contact_forces * table.contact_normals).sum(-1)
    least = np.where(touching, push, np.inf).min(1, initial=np.inf)
    return [
        table.metrics["squeeze_travel"] < bounds.min_squeeze_travel,
        table.metrics["closing_travel"] > bounds.max_closing_travel,
        (table.metrics["stable_squeeze"] < bounds.min_stable_squeeze)
        | (pinch & (table.metrics["stable_squeeze"] < bounds.min_stable_pinch)),
        table.metrics["epsilon"] < bounds.min_epsilon,
        table.metrics["pregrasp_opening"] < bounds.min_pregrasp_opening,
        table.metrics["closing_penetration"] > bounds.max_closing_penetration,
        table.metrics["closing_sweep"] > bounds.max_closing_sweep,
        least < bounds.min_force_share * np.where(touching, push, 0.0).sum(1),
    ]


def failed_bounds(table: GraspTable, outcome: np.ndarray, bounds: GraspBounds, link_groups: np.ndarray) -> np.ndarray:
    """Codes of FAILED_BOUNDS of checked rows with their outcomes, (n,) float32; 0 of rows that pass.

    Args:
        link_groups: group of each link, -1 of static ones, (L,): contacts of one group alone are too few.
    """
    touching, group = table.contact_links >= 0, link_groups[table.contact_links]
    most, least = np.where(touching, group, -1).max(1, initial=-1), np.where(touching, group, 99).min(1, initial=99)
    few = (most <= least) | (touching.sum(1) < bounds.min_contacts)
    wide = table.metrics["gap"] > bounds.max_gap
    at = {name: code for code, name in enumerate(FAILED_BOUNDS)}
    # normals are bounded beside an edge as well, which normal_error does not tell
    contact = np.select([few, wide], [at["min_contacts"], at["max_gap"]], at["max_normal_angle"])
    codes = np.zeros(max(Outcome) + 1, np.float32)
    for failed, name in _FAILED.items():
        codes[failed] = at[name]
    squeeze = np.select(failed_squeeze(table, bounds), [at[name] for name in _SQUEEZE_BOUNDS])
    late = np.where(outcome == Outcome.SQUEEZE, squeeze, codes[outcome])
    return np.where(outcome == Outcome.CONTACT, contact, late).astype(np.float32)
