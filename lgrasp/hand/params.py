"""Which surface of a hand may touch, and where its thumb is; the section ``hand`` of a pipeline."""

from typing import Any, Literal

from pydantic import Field

from lgrasp.choices import SideName, ThumbPlace
from lgrasp.config import Params

ContactLinks = Literal["listed", "all"]


class LinkSide(Params):
    """A side of a link, as surface whose outward normal is in a cone of the link's frame."""

    link: str = Field(description="Its link.")
    side: SideName = Field(description="Its name.")
    axis: tuple[float, float, float] = Field(description="Axis of the cone.")
    angle: float = Field(gt=0, le=180, description="Half angle of the cone [deg].")


class ThumbBend(Params):
    """Where a thumb is, by the hinge of its last joint: adducted where that is within an angle of the palm's normal, so
    that the thumb bends along the palm; else abducted."""

    link: str = Field(description="Its last contact link, which the hinge moves.")
    place: ThumbPlace = Field(description="Where it is.")
    axis: tuple[float, float, float] = Field(description="Axis of the hinge, link's frame.")
    normal: tuple[float, float, float] = Field(description="Of the palm's plane, base frame.")
    angle: float = Field(gt=0, lt=90, description="Between both lines, largest of an adducted thumb [deg].")


class HandParams(Params):
    """What of a hand may touch an object, and how."""

    contact_links: ContactLinks = Field(
        default="listed",
        description="listed: surface that hand.yaml lets touch; all: also the palmar side of every other finger link.",
    )
    sides: tuple[LinkSide, ...] = Field(
        default=(), description="Links that touch with one side and nothing else, as steer.links asks for them."
    )

    thumb: ThumbBend | None = Field(default=None, description="Where the thumb is, as steer.thumb asks for it.")

    def describe(self) -> dict[str, Any]:
        """What is not as by default, for content keys and shards."""
        return self.model_dump(mode="json", exclude_defaults=True)


LISTED = HandParams()
"""Surface that hand.yaml lets touch."""
