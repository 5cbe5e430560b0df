"""Numbers and origins in a URDF that is being written."""

import warnings
from collections.abc import Iterable

import numpy as np
from lxml import etree
from scipy.spatial.transform import Rotation


def number_text(values: Iterable[float]) -> str:
    """Numbers as an attribute holds them, without loss."""
    return " ".join(repr(float(x) + 0.0) for x in values)  # no negative zeros


def set_origin(element: etree._Element, xyz: np.ndarray, turn: Rotation) -> None:
    """Give an element an <origin>: translation (3,) [m], and rotation."""
    origin = element.find("origin")
    if origin is None:
        origin = etree.SubElement(element, "origin")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of gimbal lock: the angles are right then too
        origin.set("rpy", number_text(turn.as_euler("xyz")))
    origin.set("xyz", number_text(xyz))
