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
    contact_count: int = Field(
        default=8192, ge=64, le=65536, description="Contact points of objects, at least (object.contact_count)."
    )
    moves: int = Field(
        default=24,
        ge=0,
        le=255,
        description="Times that a pose which gave a grasp is moved a little, and fingers close again, where few poses "
        "give one.",
    )
    move_distance: float = Field(
        default=0.012, gt=0, le=0.1, description="How far the palm's contact moves at most, on palm and object."
    )
    move_angle: float = Field(default=20.0, ge=0, le=180, description="How far the object rolls on it at most [deg].")
    rare: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="Poses are moved where at most this share of 64 candidates in a row gave grasps.",
    )
