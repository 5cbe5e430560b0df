"""Which contact surface of a hand may touch, and which fingers must: a steering looked up in one hand."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lgrasp.config import did_you_mean
from lgrasp.errors import ConfigError
from lgrasp.hand.fingers import finger_group, finger_label
from lgrasp.hand.model import HandModel
from lgrasp.steer.params import Steering

Fingers = Mapping[str, Sequence[str]]
"""Links of each finger by its name, as hand.yaml has them."""


@dataclass(frozen=True, eq=False)
class Touching:
    """What of a hand may touch an object."""

    points: np.ndarray  # (C,) bool: contact points of the HandModel
    groups: np.ndarray  # (G,) bool: fingers
    exact: bool = False  # all these fingers touch

    @property
    def bits(self) -> int:
        """Bit g is set if group g may touch."""
        return int((self.groups << np.arange(len(self.groups))).sum())


def find_touching(steering: Steering, model: HandModel, fingers: Fingers) -> Touching:
    """What of a hand may touch under a steering; all of it if nothing is asked.

    Raises:
        ConfigError: the hand has no such finger, or it has no contact surface.
    """
    touching = Touching(np.ones(len(model.contact_points), bool), np.ones(model.groups, bool))
    if not steering.fingers:
        return touching
    group = np.repeat(np.arange(model.groups + 1), np.diff(model.contact_first))
    chosen = [_group(name, model, fingers) for name in steering.fingers]
    for number, name in enumerate(steering.fingers):
        if chosen[number] in chosen[:number]:
            other = steering.fingers[chosen.index(chosen[number])]
            raise ConfigError(f"steer.fingers: {other} and {name} of hand '{model.name}' are one; name it once")
    groups = np.isin(np.arange(model.groups), chosen)
    return Touching(touching.points & np.append(groups, True)[group], groups, True)


def _group(name: str, model: HandModel, fingers: Fingers) -> int:
    found = finger_group(model, fingers, name)
    able = np.flatnonzero(np.diff(model.contact_first[:-1])).tolist()
    if found in able:
        return found
    known = [finger_label(model, fingers, g) for g in able]
    raise ConfigError(
        f"steer.fingers: hand '{model.name}' has no finger '{name}' that may touch; {did_you_mean(name, known)}"
        f"its fingers: {', '.join(known)}"
    )
