"""hand.yaml: the few things about a hand that its URDF does not say."""

from pathlib import Path

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lgrasp.errors import HandError

__all__ = ["Box", "Cone", "ContactRule", "HandSpec", "PalmRule", "load_spec", "spec_problem"]

Vec3 = tuple[float, float, float]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Cone(_Strict):
    """Directions within ``angle`` degrees of ``axis``, in the link frame."""

    axis: Vec3
    angle: float = Field(gt=0, le=180)


class ContactRule(_Strict):
    """Finger links that may touch the object; surface whose normal lies in a forbidden cone is left out."""

    links: tuple[str, ...]
    forbidden: tuple[Cone, ...] = ()


class PalmRule(_Strict):
    """Static links that may touch the object; only surface whose normal lies in an allowed cone is used."""

    links: tuple[str, ...] = ()
    allowed: tuple[Cone, ...] = ()


class Box(_Strict):
    """Axis-aligned box in the hand base frame [m]."""

    min: Vec3
    max: Vec3


class HandSpec(_Strict):
    """Contents of hand.yaml."""

    name: str
    description: str = ""
    urdf: str = "hand.urdf"
    base_link: str | None = None
    locked: dict[str, float] = Field(default_factory=dict)
    static_links: tuple[str, ...] = ()
    contact: tuple[ContactRule, ...]
    palm: PalmRule = PalmRule()
    canonical_box: Box
    open_posture: dict[str, float] = Field(default_factory=dict)
    fingers: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    licence: str = ""
    source: str = ""
    notes: str | tuple[str, ...] = ""


def spec_problem(error: ValidationError) -> str:
    """First problem of a pydantic error as one phrase: key, value, what is wrong."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"]) or "file"
    return f"key '{key}': {first['msg']}" + (
        f" (got {first['input']!r})" if not isinstance(first["input"], dict) else ""
    )


def load_spec(path: Path) -> HandSpec:
    """Read hand.yaml.

    Raises:
        HandError: unreadable file, bad YAML, unknown key or bad value.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise HandError(f"hand file {path} cannot be read: {' '.join(str(error).split())}") from None
    if not isinstance(data, dict):
        raise HandError(f"hand file {path} must be a YAML mapping with the keys of hand.yaml")
    try:
        return HandSpec.model_validate(data)
    except ValidationError as error:
        raise HandError(f"hand file {path}: {spec_problem(error)}") from None
