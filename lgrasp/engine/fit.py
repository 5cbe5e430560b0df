"""Stage parameters that depend on the hand."""

from typing import Any

import numpy as np

from lgrasp.hand.model import HandModel
from lgrasp.stages.search.params import SearchParams


def fit_params(stage: str, params: Any, hand: HandModel) -> Any:
    """The parameters of a stage for a hand: how many finger contacts search asks for.

    A hand's own wish (hand.yaml: contacts) stands in for the default of search, and no more contacts are asked for than
    there are fingers: asking three of a gripper with two jaws would give nothing. A pure function of parameters and
    hand, both of which are in the content keys.
    """
    if stage != "search":
        return params
    asked = params.contacts
    if hand.contacts and asked == SearchParams.model_fields["contacts"].default:
        asked = hand.contacts
    fingers = int((np.diff(hand.contact_first[:-1]) > 0).sum())
    contacts = tuple(min(k, max(2, fingers)) for k in asked)
    return params if contacts == params.contacts else params.model_copy(update={"contacts": contacts})
