"""Hands that the tests build: the shipped Allegro, and real models where they lie beside the checkout."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from support.places import ASSETS

from lgrasp.hand.arrays import HandArrays, upload_hand
from lgrasp.hand.build import build_hand
from lgrasp.hand.find import find_hand
from lgrasp.hand.model import HandModel
from lgrasp.hand.spec import HandSpec

REAL = ASSETS / "hands"

CONTACT = {
    "leap": ["fingertip", "fingertip_2", "fingertip_3", "thumb_fingertip"],
    "shadow": ["ffdistal", "mfdistal", "rfdistal", "lfdistal", "thdistal"],
    "dclaw": ["link_f1_3", "link_f2_3", "link_f3_3"],
    "barrett": ["finger_1_dist_link", "finger_2_dist_link", "finger_3_dist_link"],
    "schunk_svh": ["right_hand_c", "right_hand_t", "right_hand_s", "right_hand_r", "right_hand_q"],
}
FILES = {"barrett": "barrett/barrett_mimic.urdf"}
LOCKED = {
    "shadow": {"WRJ1": -0.1, "WRJ2": 0.05},
    # both move several fingers and would merge four of them into one group
    "schunk_svh": {"right_hand_Finger_Spread": 0.2, "right_hand_Thumb_Opposition": 0.4},
}
BASE = {"shadow": "palm"}
HANDS = ["shipped", "allegro", *CONTACT]


def minimal_spec(name: str, links: list[str], **more: object) -> HandSpec:
    """Rules with nothing but the links that touch."""
    box = {"min": [0.0, 0.0, 0.0], "max": [0.1, 0.1, 0.1]}
    return HandSpec.model_validate({"name": name, "contact": [{"links": links}], "canonical_box": box, **more})


def hand_source(name: str) -> tuple[Path, HandSpec]:
    """URDF and rules of one of HANDS; skips the test when the real model is absent."""
    shipped = find_hand("allegro")
    if name == "shipped":
        return shipped.urdf, shipped.spec
    path = REAL / FILES.get(name, f"{name}/{name}.urdf")
    if not path.is_file():
        pytest.skip(f"the real hand {name} is not at ../shared/assets/hands/{path.relative_to(REAL)}")
    if name == "allegro":
        return path, shipped.spec
    more = {"locked": LOCKED.get(name, {}), "base_link": BASE.get(name)}
    return path, minimal_spec(name, CONTACT[name][:1], **more)


def with_efforts(hand: HandArrays, efforts: ArrayLike) -> HandArrays:
    """The hand with these effort limits of its joints, (K,) or one of all [N m or N]."""
    tree = hand.model.tree
    limits = np.broadcast_to(np.asarray(efforts, np.float32), tree.joint_effort.shape)
    return upload_hand(replace(hand.model, tree=replace(tree, joint_effort=limits)), hand.device)


@cache
def hand_model(name: str, *, pieces_only: bool = False) -> HandModel:
    """One of HANDS, built once per test run; without contact surface where kinematics is all that matters."""
    return build_hand(*hand_source(name), pieces_only=pieces_only)
