"""Stage parameters that a hand cannot meet as asked, lowered to what it has."""

from typing import Any

import numpy as np

from lgrasp.hand.model import HandModel

__all__ = ["fit_params"]


def fit_params(stage: str, params: Any, hand: HandModel) -> Any:
    """The parameters of a stage for a hand: search asks for no more finger contacts than there are fingers.

    A gripper has two jaws; asking for three contacts would give nothing. A pure function of parameters and hand, both of
    which are in the content keys.
    """
    if stage != "search":
        return params
    fingers = int((np.diff(hand.contact_first[:-1]) > 0).sum())
    contacts = tuple(min(k, max(2, fingers)) for k in params.contacts)
    return params if contacts == params.contacts else params.model_copy(update={"contacts": contacts})
