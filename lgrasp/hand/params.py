"""Which surface of a hand may touch; the section ``hand`` of a pipeline."""

from typing import Literal

from pydantic import Field

from lgrasp.config import Params

ContactLinks = Literal["listed", "all"]


class HandParams(Params):
    """What of a hand may touch an object."""

    contact_links: ContactLinks = Field(
        default="listed",
        description="listed: surface that hand.yaml lets touch; all: also the palmar side of every other finger link.",
    )


LISTED = HandParams()
"""Surface that hand.yaml lets touch."""
