"""Which contact surface of a hand may touch, and which fingers must: a steering looked up in one hand."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lgrasp.config import did_you_mean
from lgrasp.errors import ConfigError
from lgrasp.hand.contact_surface import palm_axis
from lgrasp.hand.fingers import finger_group, finger_label
from lgrasp.hand.model import HandModel
from lgrasp.steer.params import Steering

MOST_POSES = 4096
"""Poses that a shard tells: some 70 bytes each."""
Fingers = Mapping[str, Sequence[str]]
"""Links of each finger by its name, as hand.yaml has them."""


@dataclass(frozen=True, eq=False)
class Touching:
    """What of a hand may touch an object."""

    points: np.ndarray  # (C,) bool: contact points of the HandModel
    groups: np.ndarray  # (G,) bool: fingers
    exact: bool = False  # all these fingers touch
    palm: bool = False  # the palm touches

    @property
    def bits(self) -> int:
        """Bit g is set if group g may touch."""
        return int((self.groups << np.arange(len(self.groups))).sum())


def find_touching(steering: Steering, model: HandModel, fingers: Fingers) -> Touching:
    """What of a hand may touch under a steering; all of it if nothing is asked.

    Raises:
        ConfigError: the hand has no such finger or link, or too little of it is left to hold anything.
    """
    points, groups = np.ones(len(model.contact_points), bool), np.ones(model.groups, bool)
    group = model.contact_group
    if steering.links:
        points &= np.isin(model.contact_link, _links(list(steering.sides), model))
    if steering.palm == "no":
        points &= group < model.groups
    palm = bool(points[group == model.groups].any())
    if steering.palm == "must" and not palm:
        raise ConfigError(f"steer.palm: hand '{model.name}' has no palm surface that may touch; give yes or no")
    if steering.fingers:
        chosen = _groups(steering.fingers, model, fingers)
        points &= np.isin(group, [*chosen, model.groups])
        for name, g in zip(steering.fingers, chosen, strict=True):
            if not points[group == g].any():
                raise ConfigError(f"steer.links: none is on finger '{name}' of hand '{model.name}', which must touch")
    if steering.fingers or steering.links:
        groups = np.isin(np.arange(model.groups), group[points])
    able = len({*group[points].tolist()} - {model.groups})
    if able + palm < 2 or not able:
        left = f"only {able} of its fingers, and {'the palm' if palm else 'no palm'}"
        raise ConfigError(
            f"steer: hand '{model.name}' would touch with {left}; a grasp needs a finger and something else"
        )
    return Touching(points, groups, bool(steering.fingers), steering.palm == "must" or able == 1)


def describe_touching(
    steering: Steering, touching: Touching, model: HandModel, poses: np.ndarray | None
) -> dict[str, Any]:
    """What is asked in the words of this hand, for those who check rows: ``links`` that may touch, lists of links in
    ``every`` of which one touches, the direction ``facing`` of the palm if one is asked for, and what is asked.

    Args:
        poses: T_hand_object that are asked for, (T, 7); how many, and which if there are at most MOST_POSES.
    """
    group = model.contact_group

    def links(some: np.ndarray) -> list[str]:
        return [model.tree.link_names[link] for link in np.unique(model.contact_link[some & touching.points])]

    must = np.flatnonzero(touching.groups).tolist() if touching.exact else []
    told: dict[str, Any] = {"links": links(group >= 0)}
    told["every"] = [links(group == g) for g in (*must, *([model.groups] if touching.palm else []))]
    if steering.approach:
        told["facing"] = palm_axis(model)[1].tolist()
    if poses is not None:
        told["pose_count"] = len(poses)
        if len(poses) <= MOST_POSES:
            told["poses"] = poses.round(6).tolist()
    return told | steering.model_dump(mode="json", include={"grasp_type", "approach", "above"}, exclude_none=True)


def _links(names: Sequence[str], model: HandModel) -> list[int]:
    """Indices of contact links."""
    known = [model.tree.link_names[link] for link in np.unique(model.contact_link)]
    for name in names:
        if name not in known:
            raise ConfigError(
                f"steer.links: hand '{model.name}' has no contact surface on '{name}'; {did_you_mean(name, known)}"
                f"contact links: {', '.join(known)}"
            )
    return [model.tree.link_names.index(name) for name in names]


def _groups(names: Sequence[str], model: HandModel, fingers: Fingers) -> list[int]:
    """Groups of fingers with contact surface by their names or those of links, each once."""
    able = np.flatnonzero(np.diff(model.contact_first[:-1])).tolist()
    known = [finger_label(model.tree, fingers, g) for g in able]
    found: dict[int, str] = {}
    for name in names:
        group = finger_group(model.tree, fingers, name)
        if group not in able:
            raise ConfigError(
                f"steer.fingers: hand '{model.name}' has no finger '{name}' that may touch; "
                f"{did_you_mean(name, known)}its fingers: {', '.join(known)}"
            )
        if group in found:
            raise ConfigError(f"steer.fingers: {found[group]} and {name} of hand '{model.name}' are one; name it once")
        found[group] = name
    return list(found)
