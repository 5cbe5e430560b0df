"""Parameters of scenes; all of them decide what a scene holds, and so enter its key."""

from typing import Annotated

from pydantic import AfterValidator, Field

from lgrasp.config import Params
from lgrasp.simulate.protocol import FRICTION, in_order

_Length = Annotated[float, Field(gt=0.0, le=5.0)]
_Elevation = Annotated[float, Field(ge=5.0, le=89.0)]


class CameraParams(Params):
    """Depth cameras around the table; lengths in metres, angles in degrees."""

    views: int = Field(
        default=3, ge=1, le=16, description="Cameras, evenly around the table from a random direction on."
    )
    width: int = Field(default=320, ge=16, le=4096, description="Pixels.")
    height: int = Field(default=240, ge=16, le=4096, description="Pixels.")
    angle: float = Field(default=55.0, gt=5.0, le=150.0, description="Field of view across the width.")
    distance: Annotated[tuple[_Length, _Length], AfterValidator(in_order)] = Field(
        default=(0.7, 0.9), description="Range from the middle of the table."
    )
    elevation: Annotated[tuple[_Elevation, _Elevation], AfterValidator(in_order)] = Field(
        default=(35.0, 60.0), description="Range above the horizon."
    )
    noise: float = Field(default=0.001, ge=0.0, le=0.1, description="Standard deviation of a depth, near the camera.")
    noise_square: float = Field(
        default=0.0015, ge=0.0, le=0.1, description="Additional standard deviation per depth squared [1/m]."
    )
    calibration: float = Field(
        default=0.01, ge=0.0, le=0.1, description="Displacement of each view, in a random direction."
    )
    window: int = Field(default=3, ge=1, le=15, description="Normals: radius of the fitted window.")
    voxel: float = Field(
        default=0.003, ge=0.0, le=0.1, description="Edge of the cubes of which one point is kept; 0: all."
    )


class DropParams(Params):
    """How objects come to lie on the table; lengths in metres, times in seconds."""

    radius: _Length = Field(default=0.25, description="Objects are dropped within this distance of the table's middle.")
    gap: float = Field(
        default=0.01, ge=0.0, le=1.0, description="Least distance of dropped objects to all others at first."
    )
    friction: float = Field(default=FRICTION, gt=0.0, le=5.0)
    timestep: float = Field(default=0.002, gt=0.0, le=0.01)
    longest: float = Field(
        default=6.0, gt=0.0, le=60.0, description="If objects still move after this time, all are dropped again."
    )
    tries: int = Field(
        default=10, ge=1, le=1000, description="Times that objects are dropped until they stay on the table."
    )


class SceneParams(Params):
    """What decides a scene, beside the objects, the grasps and the seed."""

    objects: int = Field(default=5, ge=1, le=32, description="Objects on the table.")
    table: _Length = Field(default=0.8, description="Side of the square table [m].")
    tested: int = Field(
        default=1000, ge=0, le=1_000_000, description="Grasps of each object that are moved into the scene and tested."
    )
    grasps: int = Field(
        default=200, ge=0, le=1_000_000, description="Largest number of collision-free grasps kept of each object."
    )
    colliding: int = Field(
        default=40, ge=0, le=1_000_000, description="Largest number of colliding grasps kept of each object."
    )
    tolerance: float = Field(
        default=0.001, ge=0.0, le=0.01, description="How deep a hand may sink into table and other objects [m]."
    )
    camera: CameraParams = Field(default_factory=lambda: CameraParams.model_validate({}))
    drop: DropParams = Field(default_factory=lambda: DropParams.model_validate({}))
