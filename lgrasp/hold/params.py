"""Numbers of the hold test."""

from pydantic import Field

from lgrasp.simulate.protocol import PositiveRange, Range, Ranges

HOLD_VERSION = 8
"""Raised whenever the same numbers give other results."""


class HoldTest(Ranges):
    """How often each grasp is tried, and what is drawn for it; the first trial has the numbers of protocol fc."""

    draws: int = Field(default=32, ge=0, le=1000, description="Trials of each grasp with random numbers.")
    torsion: Range = Field(default=(0.0, 0.0), description="Friction against twisting [m].")
    contact_stiffness: PositiveRange = Field(
        default=(1.0e4, 1.0e5), description="Of contacts [N/m]; its logarithm is drawn evenly."
    )
