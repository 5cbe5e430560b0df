"""Options that steer grasps."""

from typing import Annotated

from typer import Option

from lgrasp.choices import PalmUse
from lgrasp_cli.names import one_of

_PANEL = "Steer"

Fingers = Annotated[
    str | None, Option(help="Fingers that all touch, and no others, such as thumb,index.", rich_help_panel=_PANEL)
]
Links = Annotated[str | None, Option(help="Links that may touch, and no others.", rich_help_panel=_PANEL)]
Palm = Annotated[
    str | None, Option(rich_help_panel=_PANEL, **one_of(PalmUse, "PALM", "Whether the palm may or must touch."))
]
