"""Outcomes of a contact set and the numbers kept of a grasp."""

REASONS = ("kept", "unused finger", "self-collision", "object collision", "contact", "balance", "unresisted load")
"""Outcome codes of a set."""

METRICS = ("fswo", "gswo", "unresisted_load", "epsilon", "penetration", "self_penetration", "gap", "normal_error")
"""Columns of the metrics table."""
