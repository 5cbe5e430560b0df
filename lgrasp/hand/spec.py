"""hand.yaml: the few things about a hand that its URDF does not say."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from lgrasp.choices import Role
from lgrasp.config import parse_model, read_yaml
from lgrasp.errors import ConfigError, HandError
from lgrasp.math.limits import MAX_KINDS

Vec3 = tuple[float, float, float]
Name = Annotated[str, Field(min_length=1)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Cone(_Strict):
    """Directions within ``angle`` degrees of ``axis``, in the link frame."""

    axis: Vec3
    angle: float = Field(gt=0, le=180)

    @field_validator("axis")
    @classmethod
    def _has_direction(cls, axis: Vec3) -> Vec3:
        if sum(x * x for x in axis) < 1e-12:
            raise ValueError("must not be zero")
        return axis


class ContactRule(_Strict):
    """Finger links that may touch the object; surface whose normal lies in a forbidden cone is left out."""

    links: tuple[Name, ...] = Field(min_length=1)
    forbidden: tuple[Cone, ...] = ()


class PalmRule(_Strict):
    """Static links that may touch the object; only surface whose normal lies in an allowed cone is used."""

    links: tuple[Name, ...] = ()
    allowed: tuple[Cone, ...] = ()


class Box(_Strict):
    """Axis-aligned box [m], in the hand base frame or, for a Surface, in its link's frame."""

    min: Vec3
    max: Vec3

    @model_validator(mode="after")
    def _is_ordered(self) -> "Box":
        if not all(a < b for a, b in zip(self.min, self.max, strict=True)):
            raise ValueError(f"min {list(self.min)} must be below max {list(self.max)} on every axis")
        return self


class Coupling(_Strict):
    """A joint's coordinate is ``multiplier`` times that of ``joint`` plus ``offset``, as in <mimic>."""

    joint: Name
    multiplier: float = 1.0
    offset: float = 0.0


class Surface(Cone):
    """Surface of links whose outward normal is in the cone (link frame), as far as it lies in ``box`` (link frame)."""

    links: tuple[Name, ...] = Field(min_length=1)
    box: Box | None = None


def _one_or_more(value: Any) -> Any:
    return (value,) if isinstance(value, dict) else value


Side = Annotated[tuple[Surface, ...], Field(min_length=1), BeforeValidator(_one_or_more)]


class OppositionSpace(_Strict):
    """Two sides that press towards each other, and the driven joints that move them; a side is one Surface or several.

    The links of a side ride on one finger, or all of them are static.
    """

    joints: tuple[Name, ...] = Field(min_length=1)
    sides: tuple[Side, Side]

    @field_validator("joints")
    @classmethod
    def _once_each(cls, joints: tuple[str, ...]) -> tuple[str, ...]:
        for name in joints:
            if joints.count(name) > 1:
                raise ValueError(f"names '{name}' twice")
        return joints


class HandSpec(_Strict):
    """Contents of hand.yaml."""

    name: Name
    description: str = ""
    approximation: str = Field(default="", exclude=True)
    """How to use the real hand, where the geometry is a primitive approximation of it."""
    urdf: str = "hand.urdf"
    base_link: str | None = None
    locked: dict[str, float] = Field(default_factory=dict)
    shared: dict[str, tuple[float, ...]] = Field(default_factory=dict)
    mimic: dict[str, Coupling] = Field(default_factory=dict)
    static_links: tuple[str, ...] = ()
    contact: tuple[ContactRule, ...] = Field(min_length=1)
    palm: PalmRule = PalmRule()
    canonical_box: Box
    stand_off: float | None = Field(default=None, gt=0, le=1)
    contacts: tuple[Annotated[int, Field(ge=1)], ...] = Field(default=(), max_length=MAX_KINDS)
    open_posture: dict[str, float] = Field(default_factory=dict)
    fingers: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    roles: dict[str, Role] = Field(default_factory=dict, exclude=True)
    """Finger -> the human one that it acts as, for grasp types alone; a steering names fingers, so no key needs it."""
    opposition_spaces: dict[Name, OppositionSpace] = Field(default_factory=dict)
    licence: str = ""
    source: str = ""
    notes: str | tuple[str, ...] = ""

    @field_validator("roles")
    @classmethod
    def _of_fingers(cls, roles: dict[str, Role], info: ValidationInfo) -> dict[str, Role]:
        fingers = info.data.get("fingers", {})
        for finger, role in roles.items():
            if finger not in fingers:
                raise ValueError(f"'{finger}' is none of fingers: {', '.join(fingers) or 'none'}")
            if [*roles.values()].count(role) > 1:
                raise ValueError(f"two fingers are '{role}'; give each role once")
        return roles


def load_spec(path: Path) -> HandSpec:
    """Read hand.yaml.

    Raises:
        HandError: unreadable file, bad YAML, unknown key or bad value.
    """
    try:
        return parse_model(HandSpec, read_yaml(path), f"hand file {path}")
    except ConfigError as error:
        raise HandError(str(error)) from None
