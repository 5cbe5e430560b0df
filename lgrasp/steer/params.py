"""What a user steers grasps by; a pipeline carries it as its section ``steer``."""

import hashlib
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, cast, get_args

from pydantic import Field, field_validator, model_validator

from lgrasp.choices import PalmUse, SideName, ThumbPlace
from lgrasp.config import Numbers, Params, comma_numbers
from lgrasp.object.region_text import ACCEPTED, Region, describe_region, parse_regions
from lgrasp.paths import user_path
from lgrasp.steer.grasp_types import find_type

if TYPE_CHECKING:
    import numpy as np

STEER_VERSION = 3
"""Raised whenever the same steering gives other grasps."""


class ApproachCone(Params):
    """Directions about one of the object's frame; as text ``x,y,z:degrees``."""

    direction: Numbers = Field(description="Its middle.")
    angle: float = Field(default=30.0, gt=0, le=180, description="Largest angle to the middle [deg].")

    @model_validator(mode="before")
    @classmethod
    def _of_text(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        direction, colon, angle = value.partition(":")
        return {"direction": comma_numbers(direction, 3)} | ({"angle": angle} if colon else {})

    @field_validator("direction")
    @classmethod
    def _of_some_length(cls, value: Numbers) -> Numbers:
        if not 1e-6 < math.hypot(*value) < math.inf:
            raise ValueError("must not be zero")
        return value


class Steering(Params):
    """Where and how a hand is to grasp; as it is by default it asks for nothing."""

    grasp_type: str | None = Field(
        default=None, description="Name of a grasp type, which says fingers, links, palm and thumb: tripod."
    )
    fingers: tuple[str, ...] = Field(
        default=(),
        description="Fingers that all touch, and no others: names of hand.yaml, or one link of each; none: any.",
    )

    links: tuple[str, ...] = Field(
        default=(),
        description="Links whose contact surface may touch, and no other, or LINK:radial, LINK:ulnar, LINK:tip: with "
        "that side; none: any.",
    )
    palm: PalmUse = Field(default="yes", description="Whether the palm touches: yes, it may; no; must.")

    thumb: ThumbPlace | None = Field(
        default=None,
        description="Where the thumb is: abducted, in the half of its range where it bends more across the palm, to "
        "oppose fingertips; adducted, more along it.",
    )

    approach: ApproachCone | None = Field(
        default=None, description="Cone, object's frame, in which the direction lies that the palm faces."
    )
    above: tuple[float, float, float, float] | None = Field(
        default=None,
        description="nx, ny, nz, d, object's frame [m]: the hand, open and on its way too, stays where n x >= d.",
    )
    pose: Path | None = Field(
        default=None, description="File of object poses in the hand's frame; only the fingers are searched."
    )

    touch: tuple[str, ...] = Field(
        default=(),
        description="Regions of the object; contacts are in one of them, or as large a share of the normal force as "
        "a number behind the last colon says: " + ACCEPTED + ".",
    )
    avoid: tuple[str, ...] = Field(default=(), description="Regions of the object that no contact is in.")

    @field_validator("above", mode="before")
    @classmethod
    def _plane(cls, value: Any) -> Any:
        return comma_numbers(value, 4) if isinstance(value, str) else value

    @field_validator("above")
    @classmethod
    def _has_normal(cls, value: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if value is not None and not (1e-6 < math.hypot(*value[:3]) < math.inf and math.isfinite(value[3])):
            raise ValueError("the normal must not be zero")
        return value

    @field_validator("grasp_type")
    @classmethod
    def _is_known(cls, value: str | None) -> str | None:
        if value is not None:
            find_type(value)
        return value

    @field_validator("pose")
    @classmethod
    def _is_there(cls, value: Path | None) -> Path | None:
        if value is not None and not user_path(value).is_file():
            raise ValueError("a folder; give one file" if user_path(value).is_dir() else "no such file")
        return value and user_path(value)

    @model_validator(mode="after")
    def _together(self) -> "Steering":
        for name in ("approach", "above") if self.pose else ():
            if getattr(self, name):
                raise ValueError(f"pose says where the hand is: leave out {name}")
        if self.pose and self.palm == "must":
            raise ValueError("pose says where the hand is: the palm cannot be put on the object")
        return self

    @field_validator("palm", mode="before")
    @classmethod
    def _word(cls, value: Any) -> Any:
        return {True: "yes", False: "no"}[value] if isinstance(value, bool) else value  # as YAML reads them

    @field_validator("touch", "avoid", mode="before")
    @classmethod
    def _one(cls, value: Any) -> Any:
        return (value,) if isinstance(value, str) else value

    @model_validator(mode="after")
    def _are_regions(self) -> Self:
        _ = self.touch_regions, self.avoid_regions  # what cannot be is told before anything is loaded
        return self

    @property
    def touch_regions(self) -> tuple[Region, ...]:
        """Regions that are to be touched.

        Raises:
            ConfigError: see :func:`~lgrasp.object.region_text.parse_regions`, as the next.
        """
        return parse_regions(self.touch, "steer.touch", share=True)

    @property
    def avoid_regions(self) -> tuple[Region, ...]:
        """Regions without contacts."""
        return parse_regions(self.avoid, "steer.avoid")

    @field_validator("fingers", "links", mode="before")
    @classmethod
    def _names(cls, value: Any) -> Any:
        return tuple(name.strip() for name in value.split(",")) if isinstance(value, str) else value

    @model_validator(mode="after")
    def _once(self) -> Self:
        if len(self.sides) < len(self.links):
            raise ValueError("links: one is named twice; name each once, with one side at most")
        return self

    @property
    def sides(self) -> dict[str, SideName | None]:
        """Each of the links, and the side that touches; None: its contact surface."""
        told: dict[str, SideName | None] = {}
        for text in self.links:
            link, _, side = text.rpartition(":")
            known = bool(link) and side in get_args(SideName)
            told[link if known else text] = cast(SideName, side) if known else None
        return told

    @property
    def asks(self) -> bool:
        """True if it asks for something."""
        return self != NOTHING

    @property
    def tag(self) -> str:
        """What is asked in a few letters, for the names of folders."""
        return hashlib.sha256(json.dumps(self.describe(), sort_keys=True).encode()).hexdigest()[:6]

    @property
    def plane(self) -> "np.ndarray | None":
        """``above`` as one plane that the object rests on (:mod:`lgrasp.object.resting`), (1, 5)."""
        if self.above is None:
            return None
        import numpy as np  # not above: options are told wrong before anything is loaded

        plane = np.array(self.above) / np.linalg.norm(self.above[:3])
        return np.append(plane, 1.0)[None].astype(np.float32)

    def describe(self) -> dict[str, Any]:
        """What is asked, for content keys and shards; empty if it is nothing."""
        told = self.model_dump(mode="json", exclude_defaults=True)
        if self.pose:
            told["pose"] = hashlib.sha256(self.pose.read_bytes()).hexdigest()
        regions = {"touch": self.touch_regions, "avoid": self.avoid_regions}
        told |= {name: [describe_region(region) for region in found] for name, found in regions.items() if found}
        return told | {"version": STEER_VERSION} if told else {}


NOTHING = Steering()
"""Asks for nothing."""
