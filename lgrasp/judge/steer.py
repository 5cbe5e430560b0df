"""Whether rows obey what their shard says was asked of them: which links touch, with which side, where the thumb is and
the palm faces, which poses, which regions of the object, and the table that it stands on."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lgrasp.judge import bounds
from lgrasp.judge.bounds import REGION_WEIGHT, JudgeError
from lgrasp.judge.collision import JudgedHand, JudgedObject, hand_in_object
from lgrasp.judge.hand import pose_transforms

COSINE_SLACK = 1e-4
"""Of the palm's direction outside its cone."""
SIDE_SLACK = 15.0
"""Of a link's normal outside the cone of its side [deg]; contacts are found on a smoother surface than the mesh."""
THUMB_SLACK = 0.1
"""Of the thumb's hinge to the palm's normal [deg]."""
PLANE_SLACK = 1e-4
"""Of the numbers of the plane that the hand stays above."""

POSE_SLACK = 1e-4
"""Between the object's pose and one that was asked for [m], turns at LEVER."""
LEVER = 0.1
"""[m]"""
_TOGETHER = 4096  # poses of a hand on its way that are looked at together


@dataclass(frozen=True)
class Thumb:
    """Where the thumb is: adducted where its last hinge is within an angle of the palm's normal, abducted elsewhere."""

    link: str  # that the hinge moves
    adducted: bool
    axis: np.ndarray  # (3,) unit, link frame
    normal: np.ndarray  # (3,) unit, base frame
    angle: float  # [deg]


@dataclass(frozen=True)
class Asked:
    """What the config of a shard says was asked, with the names that it has there."""

    links: frozenset[str] | None  # that may touch, None: any
    every: tuple[frozenset[str], ...]  # of each set one link touches
    sides: dict[str, tuple[np.ndarray, float]]  # unit axis (3,), link frame, and half angle [deg] of a link's side
    thumb: Thumb | None
    facing: np.ndarray | None  # (3,) unit vector that the palm faces along, base frame
    approach: np.ndarray | None  # (3,) unit middle of its cone, object's frame
    cosine: float
    plane: np.ndarray | None  # (4,) unit normal and height [m], object's frame, that the hand stays above
    poses: np.ndarray | None  # (T, 12) of the object, base frame, as _comparable gives them


def read_asked(config: Any) -> Asked | None:
    """What was asked, None if nothing was.

    Raises:
        KeyError, TypeError, ValueError: the config tells it in a form of its own.
    """
    told = config.get("steered") if isinstance(config, dict) else None
    if not told:
        return None
    cone, facing = told.get("approach"), None
    if cone:
        facing = _unit(told["facing"])
    plane = np.array(told["above"], float) if told.get("above") else None
    return Asked(
        links=frozenset(told["links"]) if "links" in told else None,
        every=tuple(frozenset(links) for links in told.get("every", ())),
        sides={side["link"]: (_unit(side["axis"]), float(side["angle"])) for side in told.get("sides", ())},
        thumb=_thumb(told["thumb"]) if told.get("thumb") else None,
        facing=facing,
        approach=_unit(cone["direction"]) if cone else None,
        cosine=float(np.cos(np.radians(cone["angle"]))) if cone else -1.0,
        plane=None if plane is None else plane / np.linalg.norm(plane[:3]),
        poses=_comparable(_matrices(np.array(told["poses"], float))) if told.get("poses") else None,
    )


def disobeys(
    asked: Asked,
    names: Sequence[str],
    links: np.ndarray,
    normals: np.ndarray,
    T_thumb: np.ndarray,
    T_objects: np.ndarray,
    planes: np.ndarray | None,
) -> np.ndarray:
    """Rows that do not obey, (n,) bool.

    Args:
        names: of the shard's links.
        links: in contact, -1 none, indices of ``names``, (n, C).
        normals: admissible ones of the links at the contacts, outward, link frame, (n, C, P, 3).
        T_thumb: of the link of ``asked.thumb``, base frame, (n, 4, 4); not read without.
        T_objects: of the object, base frame, (n, 4, 4).
        planes: that rows say the hand is above, object's frame, (n, 5); None: they say none.
    """
    touching = {name: (links == k).any(axis=1) for k, name in enumerate(names)}
    none = np.zeros(len(links), bool)
    others = [] if asked.links is None else [found for name, found in touching.items() if name not in asked.links]
    bad = np.logical_or.reduce([none, *others])
    for some in asked.every:
        bad |= ~np.logical_or.reduce([none, *(found for name, found in touching.items() if name in some)])
    for k, name in enumerate(names):
        if name in asked.sides:
            axis, angle = asked.sides[name]
            inside = normals @ axis >= np.cos(np.radians(min(angle + SIDE_SLACK, 180.0)))  # False where it is NaN
            bad |= ((links == k) & ~inside.any(axis=2)).any(axis=1)
    if asked.thumb is not None:
        thumb = asked.thumb
        lines = np.abs(T_thumb[:, :3, :3] @ thumb.axis @ thumb.normal)
        angle = np.degrees(np.arccos(np.minimum(lines, 1.0))) - thumb.angle
        bad |= ~((angle if thumb.adducted else -angle) <= THUMB_SLACK)
    if asked.approach is not None:
        middle = np.einsum("nij,j->ni", T_objects[:, :3, :3], asked.approach)
        bad |= ~(middle @ asked.facing >= asked.cosine - COSINE_SLACK)
    if asked.plane is not None:
        bad |= True if planes is None else ~(np.abs(planes[:, :4] - asked.plane) <= PLANE_SLACK).all(axis=1)
    if asked.poses is not None:
        bad |= ~(cKDTree(asked.poses).query(_comparable(T_objects))[0] <= POSE_SLACK)
    return bad


def _thumb(told: dict[str, Any]) -> Thumb:
    place = {"adducted": True, "abducted": False}[told["place"]]
    return Thumb(told["link"], place, _unit(told["axis"]), _unit(told["normal"]), float(told["angle"]))


def _matrices(poses: np.ndarray) -> np.ndarray:
    """Poses x y z qw qx qy qz, (T, 7), as (T, 4, 4)."""
    if poses.ndim != 2 or poses.shape[1] != 7 or not np.isfinite(poses).all():
        raise ValueError(f"poses of shape {poses.shape} are none")
    return pose_transforms(poses[:, :3], Rotation.from_quat(poses[:, 3:], scalar_first=True))


def _comparable(T: np.ndarray) -> np.ndarray:
    """Transforms (n, 4, 4) as points (n, 12) whose distances [m] are those of shifts, and of turns at LEVER."""
    return np.concatenate([T[:, :3, 3], LEVER * T[:, :3, :3].reshape(len(T), 9)], axis=1)


def _unit(vector: Sequence[float]) -> np.ndarray:
    v = np.array(vector, float)
    if v.shape != (3,) or not np.linalg.norm(v) > 0:
        raise ValueError(f"{vector} is no direction")
    return v / np.linalg.norm(v)


class JudgedRegions:
    """Surface points (S, 3) with their weights in what is to be touched and to be avoided, as rows (S, 5).

    Raises:
        JudgeError: no points, numbers that are not finite, or a share out of range.
    """

    def __init__(self, points: np.ndarray, share: float) -> None:
        if not len(points) or not np.isfinite(points).all() or not 0.0 < share <= 1.0:
            raise JudgeError(f"regions: no points, numbers that are not finite, or share {share:g} outside of (0, 1]")
        self.tree = cKDTree(points[:, :3])
        self.touch, self.avoid = (points[:, k] >= REGION_WEIGHT for k in (3, 4))
        self.share = share

    def judge(
        self, points: np.ndarray, normals: np.ndarray, forces: np.ndarray, used: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Of rows with contacts (n, C, 3), those that are ``used`` (n, C): what is missing on the part to be touched
        (of the contacts if all must be there, else of the share of the normal force), and contacts on the part to be
        avoided; (n,) each.
        """
        on, off = np.zeros(used.shape, bool), np.zeros(used.shape, bool)
        nearest = self.tree.query(points[used])[1]
        on[used], off[used] = self.touch[nearest], self.avoid[nearest]
        # every contact counts alike where all must be on the part
        push = np.ones(used.shape) if self.share == 1.0 else -(forces * normals).sum(axis=-1)
        push = np.where(used, push, 0.0)
        there = np.where(on, push, 0.0).sum(axis=1) / np.maximum(push.sum(axis=1), 1e-12)
        return np.maximum(self.share - there, 0.0), off.sum(axis=1).astype(float)


def on_table(
    hand: JudgedHand,
    obj: JudgedObject,
    planes: np.ndarray,
    T_object: np.ndarray,
    T_closing: Sequence[np.ndarray],
    T_open: np.ndarray,
    back: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How grasps stand to the table and to the way there.

    Args:
        planes: that the object rests on: unit normal up, height along it [m], any more; object's frame, shape [n, 5].
        T_object, T_open: poses of the object and of the links of the open hand, base frame, shapes [n, 4, 4] and
            [n, L, 4, 4].
        T_closing: of the links at the grasp and while they close, in any order.
        back: direction in which the open hand leaves, base frame, shape [n, 3].

    Returns:
        Depth of the lowest point of any link below the plane, closing, open, and at the start of the way; distance
        of the object's lowest point from the plane; deepest penetration of open hand and object on the way [m], (n,).
    """
    back = back / np.linalg.norm(back, axis=1, keepdims=True)
    up = np.einsum("nij,nj->ni", T_object[:, :3, :3], planes[:, :3])
    height = planes[:, 3] + np.einsum("ni,ni->n", up, T_object[:, :3, 3])
    start = _moved(T_open, bounds.APPROACH_LENGTH * back)
    below = np.max([_below(hand, T, up, height) for T in (*T_closing, T_open, start)], axis=0)
    gap = np.abs((obj.mesh.vertices @ planes[:, :3].T).min(axis=0) - planes[:, 3])
    into, depth = np.linalg.inv(T_object)[:, None], np.zeros(len(back))
    ways = np.arange(0.0, bounds.APPROACH_LENGTH + 1e-9, bounds.APPROACH_STEP)
    for some in np.array_split(ways, np.clip(len(ways) * len(back) // _TOGETHER, 1, len(ways))):
        T = np.concatenate([into @ _moved(T_open, way * back) for way in some])
        depth = np.maximum(
            depth, np.max(hand_in_object(hand, obj, T), axis=0).reshape(len(some), len(back)).max(axis=0)
        )
    return below, gap, depth


def _moved(T: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Poses (n, L, 4, 4) moved by vectors (n, 3)."""
    out = T.copy()
    out[:, :, :3, 3] += by[:, None]
    return out


def _below(hand: JudgedHand, T_links: np.ndarray, up: np.ndarray, height: np.ndarray) -> np.ndarray:
    """How deep the lowest point of any link is below planes [m], (n,), negative above."""
    depth = np.full(len(T_links), -np.inf)
    for solid in hand.solids:
        T = T_links[:, solid.link]
        normal = np.einsum("nji,nj->ni", T[:, :3, :3], up)  # link's frame
        base = np.einsum("ni,ni->n", T[:, :3, 3], up) - height
        near = np.flatnonzero(solid.radius - normal @ solid.centre - base > depth)  # the others are higher as a whole
        lowest = (solid.samples @ normal[near].T).min(axis=0) + base[near]
        depth[near] = np.maximum(depth[near], -lowest)
    return depth
