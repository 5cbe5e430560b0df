"""Outcomes of checked grasps, and the numbers kept of them."""

from enum import IntEnum

import warp as wp


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
    TOUCH = 10


KEPT = wp.constant(int(Outcome.KEPT))
UNUSED_FINGER = wp.constant(int(Outcome.UNUSED_FINGER))
SELF_COLLISION = wp.constant(int(Outcome.SELF_COLLISION))
OBJECT_COLLISION = wp.constant(int(Outcome.OBJECT_COLLISION))
CONTACT = wp.constant(int(Outcome.CONTACT))
BALANCE = wp.constant(int(Outcome.BALANCE))
UNRESISTED_LOAD = wp.constant(int(Outcome.UNRESISTED_LOAD))
TABLE = wp.constant(int(Outcome.TABLE))
APPROACH = wp.constant(int(Outcome.APPROACH))
SQUEEZE = wp.constant(int(Outcome.SQUEEZE))
TOUCH = wp.constant(int(Outcome.TOUCH))

REASONS = (
    *("kept", "unused finger", "self-collision", "object collision", "contact", "balance", "unresisted load"),
    *("table", "approach", "squeeze"),
)
"""Outcomes in words, by code; where a share of the force must be on a region there is one more, SHARED."""

SHARED = (*REASONS, "touch")

MEASURED = ("gap", "facing", "fswo", "gswo", "unresisted_load", "penetration")
"""Rows of the numbers that the checks leave on the device; ``facing`` is the least cosine of opposed normals."""

METRICS = (
    *("fswo", "gswo", "unresisted_load", "epsilon", "force_closure"),
    *("penetration", "self_penetration", "gap", "normal_error", "pregrasp_opening", "squeeze_travel"),
)
"""Columns of the metrics table."""
