"""A pose policy: two small networks that tell how likely a pose is to give a grasp, what each source of poses is worth,
and the file that keeps them."""

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.errors import ConfigError, short_reason
from lgrasp.policy.names import policy_file

WIDTH = 32
"""Channels of every layer."""
HIT_FEATURES = 9
"""Of a contact: place about the centre of mass, normal, moment."""
MOST_HITS = 8
"""Contacts of a group that a network is told."""
POINTS = 32
"""Points of the hand's reach where it is told how far the object is."""
LEAST_PROPOSALS, MOST_PROPOSALS = 16, 64
"""Poses of a candidate that a policy rates, as training proposes: few where grasps are common, many where rare."""
_FORMAT, _VERSION = "lgrasp-pose-policy", 1


@dataclass(frozen=True)
class Weights:
    """Rows of WIDTH weights: of each hit feature and a bias; of the first layer by input (for each group the mean and
    the maximum of its hits' channels, then the extras) and a bias; of the second layer and a bias; the last layer's
    weights, and its bias in the first place of one more row.

    Extras: centre of mass (3), whether the palm touches, log of each group's hits, scaled distances at points.
    """

    rows: np.ndarray

    @staticmethod
    def height(groups: int, points: int) -> int:
        """How many rows there are."""
        return (HIT_FEATURES + 1) + (2 * WIDTH * groups + 4 + groups + points + 1) + (WIDTH + 1) + 2


@dataclass(frozen=True)
class PosePolicy:
    """Networks of one hand: ``reach`` rates proposed poses, ``contacts`` those whose first contacts are realised."""

    hand: str
    joints: tuple[str, ...]
    groups: int
    points: np.ndarray
    """(M, 3) base frame [m]."""
    reach: Weights
    contacts: Weights
    sources: dict[str, float] = field(default_factory=dict)
    """Factors of the weights of stage place's sources, by name, at most 1: what each was learnt to be worth."""
    proposals: int = LEAST_PROPOSALS
    """Poses that are worth rating per candidate."""
    about: dict[str, Any] = field(default_factory=dict)
    """How it was trained."""

    def check_hand(self, name: str, joints: Sequence[str], where: object) -> None:
        """Raise ConfigError unless a hand has the joints of this one."""
        if tuple(joints) != self.joints:
            raise ConfigError(
                f"place.policy: {where} is of hand '{self.hand}' with {len(self.joints)} joints, not of '{name}'; "
                f"'lgrasp learn fit --model pose --hand {name}' makes one"
            )


def read_policy(path: str | Path) -> PosePolicy:
    """The policy of a file.

    Raises:
        ConfigError: the file cannot be read, or is no pose policy.
    """
    try:
        with np.load(io.BytesIO(policy_file(path)), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        about = json.loads(str(arrays["about"]))
        if about.pop("format") != _FORMAT or about.pop("version") != _VERSION:
            raise ValueError("other format or version")
        points = arrays["points"].astype(np.float32)
        sources = {str(name): float(worth) for name, worth in about.pop("sources", {}).items()}
        if not all(0 < worth <= 1 for worth in sources.values()):
            raise ValueError(f"factors of sources {sources}")
        proposals = int(about.pop("proposals", LEAST_PROPOSALS))
        if not 1 <= proposals <= MOST_PROPOSALS:
            raise ValueError(f"{proposals} proposals")
        made = PosePolicy(
            about.pop("hand"),
            tuple(about.pop("joints")),
            int(about.pop("groups")),
            points,
            Weights(arrays["reach"].astype(np.float32)),
            Weights(arrays["contacts"].astype(np.float32)),
            sources,
            proposals,
            about,
        )
        for weights, count in ((made.reach, len(points)), (made.contacts, 0)):
            if weights.rows.shape != (Weights.height(made.groups, count), WIDTH):
                raise ValueError(f"weights of shape {weights.rows.shape}")
            if not np.isfinite(weights.rows).all():
                raise ValueError("weights that are not finite")
        if points.shape != (len(points), 3) or not np.isfinite(points).all():
            raise ValueError("points that are none")
        return made
    except ConfigError:
        raise
    except Exception as error:  # damaged bytes make the readers of zip, npy and JSON raise almost anything
        raise ConfigError(f"place.policy: {path} is no pose policy of lgrasp ({short_reason(error, 120)})") from None


def policy_bytes(policy: PosePolicy) -> bytes:
    """The file of a policy."""
    data = io.BytesIO()
    about: dict[str, Any] = {"format": _FORMAT, "version": _VERSION, "hand": policy.hand, "joints": list(policy.joints)}
    about |= {"groups": policy.groups, "sources": policy.sources, "proposals": policy.proposals, **policy.about}
    arrays = {"points": policy.points, "reach": policy.reach.rows, "contacts": policy.contacts.rows}
    np.savez(
        data,
        allow_pickle=False,
        about=np.asarray(json.dumps(about)),
        **{name: values.astype(np.float32) for name, values in arrays.items()},
    )
    return data.getvalue()
