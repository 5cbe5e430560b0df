"""What a shard says was asked of its rows, for hands that are moved and touch anew."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lgrasp.config import parse_model
from lgrasp.errors import ConfigError, ShardError
from lgrasp.geometry.poses import device_rotation
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.find_contacts import check_found
from lgrasp.grasp.outcomes import Outcome
from lgrasp.grasp.tables import GraspTable
from lgrasp.hand.arrays import HandArrays, body_poses
from lgrasp.hand.contact_surface import ContactSurface, contact_surface
from lgrasp.hand.model import HandModel
from lgrasp.object.arrays import ObjectArrays
from lgrasp.object.regions import MEMBER
from lgrasp.steer.params import ApproachCone

_SHARE_ROUNDING = 1e-4  # of the normal force on a region
_COSINE_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class Demands:
    """Which links touch, from where the palm comes, where the thumb is, and on what part of the object.

    Attributes:
        links: That may touch, by ``link_names``, (L,) bool.
        every: Of each of them one link touches, (L,) bool.
        cone: Directions of the object's frame that the palm faces; None: any.
        facing: Direction that the palm faces, base frame, (3,).
    """

    links: np.ndarray
    every: tuple[np.ndarray, ...]
    cone: ApproachCone | None
    facing: np.ndarray

    @classmethod
    def read(cls, told: Mapping[str, Any], model: HandModel, source: str) -> "Demands":
        """Of ``steered`` in the config of a shard.

        Raises:
            ShardError: names that the hand does not have, or values that are none; with ``source``.
        """
        names = model.tree.link_names

        def some(links: Any) -> np.ndarray:
            if other := [link for link in links if link not in names]:
                raise ValueError(f"'{other[0]}' is no link of hand '{model.name}'")
            return np.isin(names, links)

        try:
            cone = parse_model(ApproachCone, told["approach"], "approach") if "approach" in told else None
            facing = np.array(told["facing"] if cone else (0.0, 0.0, 1.0), float)
            if facing.shape != (3,) or not np.linalg.norm(facing) > 0:
                raise ValueError(f"facing {facing.tolist()} is no direction")
            links = some(told["links"]) if "links" in told else np.ones(len(names), bool)
            if not links[model.contact_link].any():
                raise ValueError("links: none that has contact surface")
            return cls(links, tuple(map(some, told.get("every", ()))), cone, facing / np.linalg.norm(facing))
        except (ConfigError, KeyError, TypeError, ValueError) as error:
            raise ShardError(f"{source}: 'steered' in its config: {error}") from error

    def surface(self, model: HandModel) -> ContactSurface:
        """Where the hand may touch."""
        whole = contact_surface(model)
        return ContactSurface(*(values[self.links[whole.link]] for values in whole))

    def check(
        self,
        hand: HandArrays,
        obj: ObjectArrays,
        pose: np.ndarray,
        q: np.ndarray,
        bounds: GraspBounds,
        **options: Any,
    ) -> tuple[GraspTable, np.ndarray]:
        """:func:`~lgrasp.grasp.find_contacts.check_found`; contacts are found where the hand may touch, and rows that
        do not obey have outcome TOUCH."""
        table, outcome = check_found(hand, obj, pose, q, bounds, palmar=self.surface(hand.model), **options)
        bad = (outcome == Outcome.KEPT) & ~self.obeys(table, hand, obj)
        return table, np.where(bad, Outcome.TOUCH, outcome)

    def obeys(self, table: GraspTable, hand: HandArrays, obj: ObjectArrays) -> np.ndarray:
        """Rows that do as is asked, (n,) bool; of the thumb as ``hand``, of regions as ``obj`` has them."""
        link = table.contact_links
        used, good = link >= 0, np.ones(len(link), bool)
        good &= (self.links[link] | ~used).all(1)
        for some in self.every:
            good &= (some[link] & used).any(1)
        if self.cone is not None:
            seen = device_rotation(table.pose).inv().apply(self.facing)  # object's frame
            middle = np.array(self.cone.direction) / np.linalg.norm(self.cone.direction)
            good &= seen @ middle >= np.cos(np.radians(self.cone.angle)) - _COSINE_ROUNDING
        if body := int(hand.struct.thumb.body):
            bend = hand.struct.thumb
            axis = device_rotation(body_poses(hand, table.q)[:, body]).apply(np.array(bend.axis))
            cosine = np.abs(axis @ np.array(bend.normal))
            good &= (cosine >= bend.least - _COSINE_ROUNDING) & (cosine <= bend.most + _COSINE_ROUNDING)
        return good & _on_regions(table, obj) if obj.steered else good


def _on_regions(table: GraspTable, obj: ObjectArrays) -> np.ndarray:
    """Rows whose contacts are where they may be, with as much of the normal force as must be there, (n,) bool."""
    assert obj.steered is not None
    used, share = table.contact_links >= 0, obj.steered.weights.share
    near = obj.steered.weights.near(table.contact_points[used] + obj.model.center)
    on, off = np.zeros(used.shape, bool), np.zeros(used.shape, bool)
    on[used], off[used] = (near >= MEMBER).T
    if share == 1.0:
        return ~(off | (used & ~on)).any(1)
    push = np.where(used, -(table.contact_forces * table.contact_normals).sum(-1), 0.0)
    return ~off.any(1) & ((push * on).sum(1) >= (share - _SHARE_ROUNDING) * push.sum(1))
