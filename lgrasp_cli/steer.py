"""Options that steer grasps."""

from functools import partial
from pathlib import Path
from typing import Annotated

from typer import Option

from lgrasp.choices import PalmUse, ThumbPlace
from lgrasp_cli.names import GRASP_TYPE, one_of

_option = partial(Option, rich_help_panel="Steer")

GraspType = Annotated[
    str | None, _option(help="Grasp type, such as tripod; lgrasp hands show lists a hand's.", **GRASP_TYPE)
]
Fingers = Annotated[
    str | None, _option(metavar="NAMES", help="Fingers that must all touch, and no others, such as thumb,index.")
]
Links = Annotated[
    str | None,
    _option(
        metavar="NAMES", help="The only links that may touch; LINK:radial, LINK:ulnar or LINK:tip: only with that side."
    ),
]
Palm = Annotated[str | None, _option(**one_of(PalmUse, "PALM", "Whether the palm may or must touch."))]
Thumb = Annotated[
    str | None, _option(**one_of(ThumbPlace, "PLACE", "Where the thumb is: across the palm or along it."))
]
Approach = Annotated[
    str | None,
    _option(
        metavar="X,Y,Z:DEG",
        help="Directions that the palm may face, a cone in the object's frame; 0,0,-1:30 is from above.",
    ),
]
Above = Annotated[
    str | None,
    _option(
        metavar="X,Y,Z,D", help="Keep the hand and its approach where X x + Y y + Z z >= D (object's frame, metres)."
    ),
]
PoseFile = Annotated[
    Path | None,
    _option(
        "--pose",
        metavar="FILE",
        help="Object poses in the hand's frame (npz, csv or a shard); only fingers are searched.",
    ),
]
Touch = Annotated[
    list[str] | None,
    _option(
        metavar="REGION",
        help="Region that must contain all contacts (with :0.7 appended, 70 % of the force): box:x0,y0,z0:x1,y1,z1, "
        "sphere:x,y,z:r, group:NAME, color:#rrggbb, a closed mesh, an .npz of weights per vertex; repeatable.",
    ),
]
Avoid = Annotated[list[str] | None, _option(metavar="REGION", help="Region without contacts; repeatable.")]
