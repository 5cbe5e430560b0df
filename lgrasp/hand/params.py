"""Which surface of a hand may touch; the section ``hand`` of a pipeline."""

from typing import Any, Literal

from pydantic import Field

from lgrasp.choices import SideName
from lgrasp.config import Params

ContactLinks = Literal["listed", "all"]


class LinkSide(Params):
    """A side of a link, as surface whose outward normal is in a cone of the link's frame."""

    link: str = Field(description="Its link.")
    side: SideName = Field(description="Its name.")
    axis: tuple[float, float, float] = Field(description="Axis of the cone.")
    angle: float = Field(gt=0, le=180, description="Half angle of the cone [deg].")


class HandParams(Params):
    """What of a hand may touch an object."""

    contact_links: ContactLinks = Field(
        default="listed",
        description="listed: surface that hand.yaml lets touch; all: also the palmar side of every other finger link.",
    )
    sides: tuple[LinkSide, ...] = Field(
        default=(), description="Links that touch with one side and nothing else, as steer.links asks for them."
    )

    def describe(self) -> dict[str, Any]:
        """What is not as by default, for content keys and shards."""
        return self.model_dump(mode="json", exclude_defaults=True)


LISTED = HandParams()
"""Surface that hand.yaml lets touch."""
