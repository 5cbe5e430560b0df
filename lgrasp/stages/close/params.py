"""Parameters of the close stage."""

from pydantic import Field

from lgrasp.config import Params
from lgrasp.stages.least_squares import Gap, Indentation


class CloseParams(Params):
    """How fingers close until they touch; lengths in metres."""

    joints: float = Field(
        default=1.0,
        ge=0,
        le=8,
        description="Where a pipeline has stage ik as well: hands whose fingers have no more joints of their own than "
        "this on the mean close them, without domain, ik and wrap; others leave this stage out.",
    )
    steps: int = Field(default=10, ge=1, le=1000, description="Steps of a finger from wide open to closed.")
    iterations: int = Field(default=6, ge=1, le=100, description="Most Newton steps until a link touches.")
    contact_indentation: Indentation = 0.0003
    gap: Gap = 0.0007
    settings: int = Field(
        default=8,
        ge=1,
        le=1024,
        description="Values of joints that fingers share, such as a spread: tried at a pose, one after another, until "
        "enough fingers touch.",
    )
    policy_proposals: int = Field(
        default=32,
        ge=1,
        le=1024,
        description="Poses that a policy rates per candidate, at most (place.policy_proposals).",
    )
    moves: int = Field(
        default=24,
        ge=0,
        le=128,
        description="Where fewer than one pose in twenty gives grasps, so many are tried near each that does.",
    )
    contact_count: int = Field(
        default=8192, ge=64, le=65536, description="Contact points of objects, at least (object.contact_count)."
    )
