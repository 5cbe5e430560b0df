"""Parameters of the wrap stage."""

from pydantic import Field

from lgrasp.config import Params
from lgrasp.stages.least_squares import Damping, Gap, Indentation, JointStep


class WrapParams(Params):
    """How further links of a finger are laid on the object; lengths in metres."""

    iterations: int = Field(default=8, ge=1, le=100, description="Damped least-squares steps for each further link.")
    rounds: int = Field(default=3, ge=1, le=8, description="Links of a finger that are tried, the nearest first.")
    reach: float = Field(default=0.02, gt=0, le=0.1, description="Links farther from the object are left alone.")
    normal_weight: float = Field(default=0.15, ge=0, le=10, description="Weight of the contacts' normals.")
    damping: Damping = 1e-5
    step: JointStep = 0.3
    contact_indentation: Indentation = 0.0003
    gap: Gap = 0.0007
