"""Parameters of the published optimiser and of the Langevin sampler beside it."""

from typing import Literal

from pydantic import Field

from lgrasp.config import Params


class OptimiserParams(Params):
    """Minimisation of the grasp energy from random starts; lengths in metres.

    Iterations and weights but ``w_hop`` are published ones, the rest is as in the authors' program.
    """

    iterations: int = Field(6000, ge=1, le=1_000_000, description="Steps for each object.")
    step: float = Field(0.005, gt=0, le=1, description="First step of each coordinate [m, rad or 1].")
    step_decay: float = Field(0.95, gt=0, le=1, description="Factor of the step ...")
    step_period: float = Field(50, gt=0, description="... in this many iterations.")
    smoothing: float = Field(0.98, ge=0, lt=1, description="Memory of the mean square that gradients are divided by.")
    temperature: float = Field(32, gt=0, description="First temperature.")
    temperature_decay: float = Field(0.95, gt=0, le=1, description="Factor of the temperature ...")
    temperature_period: float = Field(30, gt=0, description="... in this many iterations.")
    mala_temperature: float = Field(4, gt=0, description="First temperature of method mala.")
    mala_turn: float = Field(20, gt=0, description="Noise of angles against that of positions [rad/m], method mala.")
    switch: float = Field(0.3, ge=0, le=1, description="Probability that a contact point is redrawn in a step.")

    w_fc: float = Field(50, ge=0, description="Weight of force closure.")
    w_dis: float = Field(50, ge=0, description="Weight of the distance of contacts.")
    w_hop: tuple[float, float] = Field((5, 36.9), description="First and last weight of hand-object penetration.")
    w_hop_growth: Literal["exponential", "linear"] = Field(
        "exponential", description="How it grows: as in the authors' program, or as the paper has it."
    )
    w_hsp: float = Field(5, ge=0, description="Weight of the hand's penetration of itself.")
    w_joint: float = Field(1, ge=0, description="Weight of joints beyond their limits.")
    w_oop: float = Field(5, ge=0, description="Weight of object-object penetration.")

    hand_points: int = Field(2048, ge=64, le=65_536, description="Surface points of the hand.")
    object_points: int = Field(2048, ge=64, le=65_536, multiple_of=16, description="Surface points of an object.")
    point_unit: float = Field(2048, gt=0, description="Points that mean depths are multiplied by.")
