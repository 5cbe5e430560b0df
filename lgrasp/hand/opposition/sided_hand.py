"""The hand as a grasp with the sides of links sees it."""

from collections.abc import Sequence
from dataclasses import replace

from lgrasp.errors import HandError
from lgrasp.hand.find import HandSource
from lgrasp.hand.model import HandModel
from lgrasp.hand.opposition.spaces import side_surface
from lgrasp.hand.params import LinkSide
from lgrasp.hand.spec import Surface
from lgrasp.hand.urdf import read_urdf
from lgrasp.hand.whole_hand import listed_links, surface_arrays


def sided_hand(source: HandSource, model: HandModel, sides: Sequence[LinkSide], device: str) -> HandModel:
    """The same hand, some of whose links touch with a side and with nothing else.

    Args:
        source: what ``model`` was built from. device: answers the geometric queries.

    Raises:
        HandError: a link without surface on its side.
    """
    urdf = read_urdf(source.urdf)
    surfaces = [Surface(links=(side.link,), axis=side.axis, angle=side.angle) for side in sides]
    found = side_surface(urdf, model.tree, surfaces, device)
    for side in sides:
        if side.link not in {entry.link for entry in found}:
            raise HandError(
                f"hand '{model.name}': link '{side.link}' has no {side.side} side that an object can reach "
                f"(hand.sides: normals within {side.angle:g} degrees of {list(side.axis)})"
            )
    named = {side.link for side in sides}
    links = [*(entry for entry in listed_links(model) if entry.link not in named), *found]
    return replace(model, **surface_arrays(model, urdf, links, device))
