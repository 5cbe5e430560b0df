"""Whether rows obey what their shard says was asked of them: which links touch, with which side, where the thumb is and
the palm faces, which poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

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
        bad |= True if planes is None else (np.abs(planes[:, :4] - asked.plane) > PLANE_SLACK).any(axis=1)
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
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(poses[:, 3:], scalar_first=True).as_matrix()
    T[:, :3, 3] = poses[:, :3]
    return T


def _comparable(T: np.ndarray) -> np.ndarray:
    """Transforms (n, 4, 4) as points (n, 12) whose distances [m] are those of shifts, and of turns at LEVER."""
    return np.concatenate([T[:, :3, 3], LEVER * T[:, :3, :3].reshape(len(T), 9)], axis=1)


def _unit(vector: Sequence[float]) -> np.ndarray:
    v = np.array(vector, float)
    if v.shape != (3,) or not np.linalg.norm(v) > 0:
        raise ValueError(f"{vector} is no direction")
    return v / np.linalg.norm(v)
