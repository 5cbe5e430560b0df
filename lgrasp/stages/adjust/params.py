"""Parameters of the adjust stage."""

from pydantic import Field

from lgrasp.config import Params
from lgrasp.stages.least_squares import Damping, Gap, Indentation, JointStep


class AdjustParams(Params):
    """How object and fingers move together until the contacts of a set are made; lengths in metres."""

    joints: float = Field(
        default=3.0,
        ge=0,
        le=8,
        description="Where a pipeline has stage ik as well: hands whose fingers have no more joints of their own than "
        "this on the mean are adjusted, without ik; fingers of others move alone, by ik.",
    )
    iterations: int = Field(default=20, ge=1, le=200, description="Most damped least-squares steps.")
    patience: int = Field(
        default=4, ge=0, le=200, description="Steps after which a set is given up while its contacts are far."
    )
    lever: float = Field(default=0.01, gt=0, le=0.1, description="Length that makes turns comparable to distances.")
    normal_weight: float = Field(default=0.15, gt=0, le=10, description="Weight of the angle of normals at contacts.")
    slide_weight: float = Field(default=0.05, gt=0, le=1, description="Weight of contacts that slide along a link.")
    depth_weight: float = Field(
        default=3.0, ge=0, le=100, description="Weight of the deepest point of each body in the object."
    )
    left_penetration: float = Field(
        default=0.0001, ge=0, le=0.01, description="Penetration that bodies are not pushed out of."
    )
    damping: Damping = 2e-6
    object_damping: float = Field(
        default=0.01, gt=0, le=1e6, description="Damping of the object's motion; of its turn, times the lever squared."
    )
    step: JointStep = 0.3
    object_step: float = Field(default=0.01, gt=0, le=0.1, description="Largest move of the object in one step.")
    object_turn: float = Field(default=10.0, gt=0, le=90, description="Largest turn of the object in one step [deg].")
    contact_indentation: Indentation = 0.0003
    gap: Gap = 0.001
    angle: float = Field(default=15.0, gt=0, le=60, description="Largest angle of the normals at a contact [deg].")
