"""Parameters of the hold stage."""

from lgrasp.hold.params import HoldTest


class HoldParams(HoldTest):
    """How often each grasp is tried, and with what numbers; which are kept is a bound, ``min_hold_probability``."""
