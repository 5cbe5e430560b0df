"""Joint tree -> dependency groups, actuated joints and the flat tables of the Warp forward kinematics."""

from dataclasses import dataclass

import numpy as np

from lgrasp.errors import HandError
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.urdf import Joint, Urdf

__all__ = ["Tree", "build_tree"]


@dataclass(frozen=True)
class Tree:
    """Tables of a hand's kinematics; G groups, J movable joints in group order, D = K actuated joints.

    Body 0 is the static base; body 1 + j is moved by joint j. Every link rides on one body.
    """

    base_link: str
    joint_names: tuple[str, ...]  # K actuated joints in the order of q
    joint_lower: np.ndarray  # (K,) [rad or m]
    joint_upper: np.ndarray  # (K,)
    joint_open: np.ndarray  # (K,) the open posture
    joint_first: np.ndarray  # (G + 1,) i32
    dof_first: np.ndarray  # (G + 1,) i32
    joint_parent: np.ndarray  # (J,) i32, inside the group, -1 = base
    joint_dof: np.ndarray  # (J,) i32, inside the group
    joint_mult: np.ndarray  # (J,)
    joint_offset: np.ndarray  # (J,)
    joint_axis: np.ndarray  # (J, 3)
    joint_prismatic: np.ndarray  # (J,) i32
    T_parent_joint: np.ndarray  # (J, 4, 4)
    dof_index: np.ndarray  # (K,) i32: column of q that group-ordered dof d is
    locked_names: tuple[str, ...]  # actuated joints held at a value; shards list them after those of q
    locked_values: np.ndarray  # (H,) [rad or m]
    locked_limits: np.ndarray  # (H, 2)
    link_names: tuple[str, ...]
    link_body: np.ndarray  # (L,) i32
    T_body_link: np.ndarray  # (L, 4, 4)

    @property
    def groups(self) -> int:
        return len(self.joint_first) - 1

    @property
    def body_group(self) -> np.ndarray:
        """(1 + J,) i32: group of each body, -1 for the base."""
        return np.concatenate([[-1], np.repeat(np.arange(self.groups), np.diff(self.joint_first))]).astype(np.int32)


def _fixed_value(j: Joint, locked: dict[str, float], by_name: dict[str, Joint]) -> float | None:
    """Coordinate of a joint that cannot move: locked itself, or mimicking a locked one."""
    if j.name in locked:
        return locked[j.name]
    if j.mimic is not None:
        source = _fixed_value(by_name[j.mimic[0]], locked, by_name)
        return None if source is None else j.mimic[1] * source + j.mimic[2]
    return None


def _motion(j: Joint, x: float) -> np.ndarray:
    T = np.eye(4)
    if j.prismatic:
        T[:3, 3] = j.axis * x
        return T
    a = j.axis
    K = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    T[:3, :3] = np.eye(3) + np.sin(x) * K + (1 - np.cos(x)) * K @ K
    return T


def build_tree(urdf: Urdf, spec: HandSpec) -> Tree:
    """Split the hand into static base and dependency groups.

    Groups are the connected components of the tree without static links; a mimic joint joins the group of its source.

    Raises:
        HandError: spec names a joint or link that does not exist, or a locked value is outside the limits.
    """
    by_name = {j.name: j for j in urdf.joints}
    for name, value in spec.locked.items():
        if name not in by_name or not by_name[name].movable:
            raise HandError(f"hand '{spec.name}': locked joint '{name}' is not a movable joint of {urdf.path}")
        if not by_name[name].lower - 1e-6 <= value <= by_name[name].upper + 1e-6:
            raise HandError(
                f"hand '{spec.name}': locked joint '{name}' = {value} is outside its limits "
                f"[{by_name[name].lower}, {by_name[name].upper}]"
            )
    for name in spec.open_posture:
        if name not in by_name or not by_name[name].movable:
            raise HandError(f"hand '{spec.name}': open_posture names '{name}', not a movable joint of {urdf.path}")
    for link in (*spec.static_links, *(x for links in spec.fingers.values() for x in links)):
        if link not in urdf.links:
            raise HandError(f"hand '{spec.name}': '{link}' (static_links or fingers) is not a link of {urdf.path}")
    base = spec.base_link or urdf.root
    if base not in urdf.links:
        raise HandError(f"hand '{spec.name}': base_link '{base}' is not a link of {urdf.path}")

    # each link: the movable joint it rides on (None = static) and its pose in that joint's moving frame (or the root)
    rides: dict[str, tuple[str | None, np.ndarray]] = {urdf.root: (None, np.eye(4))}
    parent_of: dict[str, str | None] = {}
    pose_of: dict[str, np.ndarray] = {}
    moving: list[Joint] = []
    for j in urdf.joints:
        carrier, T = rides[j.parent]
        T = T @ j.T_parent_joint
        value = _fixed_value(j, spec.locked, by_name) if j.movable else 0.0
        if value is not None:
            rides[j.child] = (carrier, T @ _motion(j, value) if j.movable else T)
        else:
            parent_of[j.name], pose_of[j.name] = carrier, T
            moving.append(j)
            rides[j.child] = (j.name, np.eye(4))
    if not moving:
        raise HandError(f"hand '{spec.name}': every joint of {urdf.path} is locked; leave some to move")
    # the base frame: the base link must be static
    if rides[base][0] is not None:
        raise HandError(
            f"hand '{spec.name}': base_link '{base}' is moved by joint '{rides[base][0]}'; name a static link"
        )
    T_base_root = np.linalg.inv(rides[base][1])
    for link, (carrier, T) in rides.items():
        if carrier is None:
            rides[link] = (None, T_base_root @ T)
    for name, carrier in parent_of.items():
        if carrier is None:
            pose_of[name] = T_base_root @ pose_of[name]

    groups = _group(moving, parent_of)
    order = [j for members in groups for j in members]
    local = {j.name: i for members in groups for i, j in enumerate(members)}
    actuated = [j for j in urdf.joints if j in moving and j.mimic is None]
    column = {j.name: i for i, j in enumerate(actuated)}
    dof_first, dof_index, dof_local = [0], [], {}
    for members in groups:
        for j in members:
            if j.mimic is None:
                dof_local[j.name] = len(dof_index) - dof_first[-1]
                dof_index.append(column[j.name])
        dof_first.append(len(dof_index))
    drive = [_drive(j, by_name) for j in order]
    lower, upper = _limits(actuated, order, drive, spec)
    opened = np.clip(np.array([spec.open_posture.get(j.name, 0.0) for j in actuated]), lower, upper)
    body = {j.name: 1 + i for i, j in enumerate(order)}
    links = list(urdf.links)
    locked = [j for j in urdf.joints if j.mimic is None and j.name in spec.locked]
    return Tree(
        base_link=base,
        joint_names=tuple(j.name for j in actuated),
        joint_lower=lower.astype(np.float32),
        joint_upper=upper.astype(np.float32),
        joint_open=opened.astype(np.float32),
        joint_first=np.cumsum([0, *(len(m) for m in groups)]).astype(np.int32),
        dof_first=np.array(dof_first, np.int32),
        joint_parent=np.array([-1 if (p := parent_of[j.name]) is None else local[p] for j in order], np.int32),
        joint_dof=np.array([dof_local[source] for source, _, _ in drive], np.int32),
        joint_mult=np.array([m for _, m, _ in drive], np.float32),
        joint_offset=np.array([b for _, _, b in drive], np.float32),
        joint_axis=np.array([j.axis for j in order], np.float32),
        joint_prismatic=np.array([j.prismatic for j in order], np.int32),
        T_parent_joint=np.array([pose_of[j.name] for j in order]),
        dof_index=np.array(dof_index, np.int32),
        locked_names=tuple(j.name for j in locked),
        locked_values=np.array([spec.locked[j.name] for j in locked], np.float32),
        locked_limits=np.array([(j.lower, j.upper) for j in locked], np.float32).reshape(-1, 2),
        link_names=tuple(links),
        link_body=np.array([0 if (c := rides[n][0]) is None else body[c] for n in links], np.int32),
        T_body_link=np.array([rides[n][1] for n in links]),
    )


def _group(moving: list[Joint], parent_of: dict[str, str | None]) -> list[list[Joint]]:
    """Connected components: joints that share an ancestor joint, or a mimic source."""
    label = {j.name: j.name for j in moving}

    def find(name: str) -> str:
        while label[name] != name:
            name = label[name]
        return name

    for j in moving:
        for other in (parent_of[j.name], j.mimic[0] if j.mimic else None):
            if other is not None:
                label[find(j.name)] = find(other)
    groups: dict[str, list[Joint]] = {}
    for j in moving:
        groups.setdefault(find(j.name), []).append(j)
    return list(groups.values())


def _drive(j: Joint, by_name: dict[str, Joint]) -> tuple[str, float, float]:
    """The actuated joint behind j, with multiplier and offset composed along the mimic chain."""
    mult, offset = 1.0, 0.0
    while j.mimic is not None:
        source, m, b = j.mimic
        # x_j = m * x_source + b
        offset += mult * b
        mult *= m
        j = by_name[source]
    return j.name, mult, offset


def _limits(
    actuated: list[Joint], order: list[Joint], drive: list[tuple[str, float, float]], spec: HandSpec
) -> tuple[np.ndarray, np.ndarray]:
    """Limits of the actuated joints [rad or m], narrowed so that every mimic joint stays inside its own."""
    lower = {j.name: j.lower for j in actuated}
    upper = {j.name: j.upper for j in actuated}
    for j, (source, mult, offset) in zip(order, drive, strict=True):
        if j.mimic is None or mult == 0.0:
            continue
        a, b = sorted(((j.lower - offset) / mult, (j.upper - offset) / mult))
        lower[source], upper[source] = max(lower[source], a), min(upper[source], b)
    for j in actuated:
        if lower[j.name] >= upper[j.name]:
            raise HandError(
                f"hand '{spec.name}': joint '{j.name}' has no room left; the limits of the joints that mimic it "
                "exclude each other"
            )
    return np.array([lower[j.name] for j in actuated]), np.array([upper[j.name] for j in actuated])
