"""Where a user puts something."""

from typing import TYPE_CHECKING, Any

from pydantic import Field, model_validator

from lgrasp.config import Numbers, Params, comma_numbers

if TYPE_CHECKING:
    import numpy as np


class Placement(Params):
    """A pose; as text ``x,y,z``, ``x,y,z:yaw`` or ``x,y,z:roll,pitch,yaw``; as a list x, y, z."""

    position: Numbers = Field(description="x, y, z [m].")
    angles: Numbers = Field(
        default=(0.0, 0.0, 0.0), description="Roll, pitch, yaw: turns about the fixed axes x, then y, then z [deg]."
    )

    @model_validator(mode="before")
    @classmethod
    def _of_text(cls, value: Any) -> Any:
        if isinstance(value, list | tuple):
            return {"position": value}
        if not isinstance(value, str):
            return value
        position, colon, angles = value.partition(":")
        found: dict[str, Any] = {"position": comma_numbers(position, 3)}
        if colon:
            found["angles"] = comma_numbers(angles, 3) if "," in angles else (0.0, 0.0, *comma_numbers(angles, 1))
        return found

    @property
    def pose(self) -> "np.ndarray":
        """x y z [m] qw qx qy qz, shape [7]."""
        import numpy as np  # not above: options are told wrong before anything is loaded

        from lgrasp.geometry.poses import quaternion_from_euler

        return np.concatenate([self.position, quaternion_from_euler(np.radians(self.angles))])


ORIGIN = Placement(position=(0.0, 0.0, 0.0))
"""In place."""
