"""Joint tree -> dependency groups, actuated joints and the flat tables of the Warp forward kinematics."""

import itertools
from dataclasses import dataclass, replace

import numpy as np

from lgrasp.errors import HandError
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.urdf import Joint, Urdf, check_mimic

MAX_SETTINGS = 32
"""Most combinations of values of a hand's shared joints."""


@dataclass(frozen=True)
class Tree:
    """Tables of a hand's kinematics; G groups, J movable joints in group order, K actuated joints, D drives of groups.

    Body 0 is the static base; body 1 + j is moved by joint j. Every link rides on one body. A joint that several groups
    share (and what mimics it) is in each of them, once with the links that ride on it, else bare; so D >= K and every
    group stands by itself once the shared joints have a value. Shared joints only take the values of a setting.
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
    dof_index: np.ndarray  # (D,) i32: column of q that group-ordered dof d is
    dof_free: np.ndarray  # (G,) i32: dofs that a group moves itself; they come first, shared ones after
    shared_names: tuple[str, ...]  # joints that several groups share
    settings: np.ndarray  # (V, K) open posture with the shared joints at their values; V >= 1
    locked_names: tuple[str, ...]  # actuated joints held at a value; shards list them after those of q
    locked_values: np.ndarray  # (H,) [rad or m]
    locked_limits: np.ndarray  # (H, 2)
    coupled_names: tuple[str, ...]  # joints that only hand.yaml couples; shards list them after the locked ones
    coupled_column: np.ndarray  # (M,) i32: column of q that drives each
    coupled_mult: np.ndarray  # (M,)
    coupled_offset: np.ndarray  # (M,) [rad or m]
    coupled_limits: np.ndarray  # (M, 2)
    link_names: tuple[str, ...]
    link_body: np.ndarray  # (L,) i32
    T_body_link: np.ndarray  # (L, 4, 4)

    @property
    def listed_names(self) -> tuple[str, ...]:
        """Joints of a shard: with them and the URDF alone every link has its place."""
        return (*self.joint_names, *self.locked_names, *self.coupled_names)

    @property
    def listed_limits(self) -> np.ndarray:
        """Limits of the listed joints [rad or m], shape [K + H + M, 2]."""
        own = np.column_stack([self.joint_lower, self.joint_upper])
        return np.concatenate([own, self.locked_limits, self.coupled_limits])

    def listed_values(self, q: np.ndarray) -> np.ndarray:
        """Values of the listed joints [rad or m], shape [n, K + H + M], for actuated joints q, shape [n, K]."""
        locked = np.broadcast_to(self.locked_values, (len(q), len(self.locked_values)))
        coupled = self.coupled_mult * q[:, self.coupled_column] + self.coupled_offset
        return np.hstack([q, locked, coupled]).astype(q.dtype)

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
    Shared joints connect nothing.

    Raises:
        HandError: spec names a joint or link that does not exist, or a locked or shared value is outside the limits.
    """
    stated = {j.name for j in urdf.joints if j.mimic is not None}
    urdf = _with_mimic(urdf, spec)
    by_name = {j.name: j for j in urdf.joints}
    for name, value in spec.locked.items():
        if name not in by_name or not by_name[name].movable:
            raise HandError(f"hand '{spec.name}': locked joint '{name}' is not a movable joint of {urdf.path}")
        if not by_name[name].lower - 1e-6 <= value <= by_name[name].upper + 1e-6:
            raise HandError(
                f"hand '{spec.name}': locked joint '{name}' = {value} is outside its limits "
                f"[{by_name[name].lower}, {by_name[name].upper}]"
            )
        if (mimic := by_name[name].mimic) is not None:
            raise HandError(
                f"hand '{spec.name}': joint '{name}' is locked but follows joint '{mimic[0]}'; lock that one instead"
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

    drive = {j.name: _drive(j, by_name) for j in moving}
    shared = _check_shared(spec, moving, urdf)
    groups = _group(moving, parent_of, drive, shared)
    actuated = [j for j in urdf.joints if j in moving and j.mimic is None]
    column = {j.name: i for i, j in enumerate(actuated)}
    dof_first, dof_index, dof_free, joint_dof, joint_parent = [0], [], [], [], []
    body: dict[str, int] = {}
    for members in groups:
        sources = dict.fromkeys(drive[j.name][0] for j in members)
        own = [n for n in sources if n not in shared]
        place = {n: i for i, n in enumerate([*own, *(n for n in sources if n in shared)])}
        local = {j.name: i for i, j in enumerate(members)}
        for j in members:
            up = parent_of[j.name]
            joint_dof.append(place[drive[j.name][0]])
            joint_parent.append(-1 if up is None else local[up])
            # the links of a joint that is in several groups ride with the first
            body.setdefault(j.name, len(joint_dof))
        dof_index += [column[n] for n in place]
        dof_first.append(len(dof_index))
        dof_free.append(len(own))
    order = [j for members in groups for j in members]
    lower, upper = _limits(actuated, moving, drive, spec)
    opened = np.clip(np.array([spec.open_posture.get(j.name, 0.0) for j in actuated]), lower, upper)
    settings = _settings(spec, shared, column, opened, lower, upper)
    links = list(urdf.links)
    # joints that the URDF by itself would leave at 0: locked ones, and those that only hand.yaml couples
    unstated = [j for j in urdf.joints if j.mimic is not None and j.name not in stated]
    held = [(j, _fixed_value(j, spec.locked, by_name)) for j in urdf.joints if j.name in spec.locked or j in unstated]
    locked = [(j, value) for j, value in held if value is not None]
    coupled = [(j, drive[j.name]) for j in unstated if j.name in drive]
    return Tree(
        base_link=base,
        joint_names=tuple(j.name for j in actuated),
        joint_lower=lower.astype(np.float32),
        joint_upper=upper.astype(np.float32),
        joint_open=settings[0],
        joint_first=np.cumsum([0, *(len(m) for m in groups)]).astype(np.int32),
        dof_first=np.array(dof_first, np.int32),
        joint_parent=np.array(joint_parent, np.int32),
        joint_dof=np.array(joint_dof, np.int32),
        joint_mult=np.array([drive[j.name][1] for j in order], np.float32),
        joint_offset=np.array([drive[j.name][2] for j in order], np.float32),
        joint_axis=np.array([j.axis for j in order], np.float32),
        joint_prismatic=np.array([j.prismatic for j in order], np.int32),
        T_parent_joint=np.array([pose_of[j.name] for j in order]),
        dof_index=np.array(dof_index, np.int32),
        dof_free=np.array(dof_free, np.int32),
        shared_names=shared,
        settings=settings,
        locked_names=tuple(j.name for j, _ in locked),
        locked_values=np.array([value for _, value in locked], np.float32),
        locked_limits=_own_limits([j for j, _ in locked]),
        coupled_names=tuple(j.name for j, _ in coupled),
        coupled_column=np.array([column[source] for _, (source, _, _) in coupled], np.int32),
        coupled_mult=np.array([mult for _, (_, mult, _) in coupled], np.float32),
        coupled_offset=np.array([offset for _, (_, _, offset) in coupled], np.float32),
        coupled_limits=_own_limits([j for j, _ in coupled]),
        link_names=tuple(links),
        link_body=np.array([0 if (c := rides[n][0]) is None else body[c] for n in links], np.int32),
        T_body_link=np.array([rides[n][1] for n in links]),
    )


def _with_mimic(urdf: Urdf, spec: HandSpec) -> Urdf:
    """The URDF with the couplings that hand.yaml adds."""
    by_name = {j.name: j for j in urdf.joints}
    for name, coupling in spec.mimic.items():
        for end in (name, coupling.joint):
            if end not in by_name or not by_name[end].movable:
                raise HandError(f"hand '{spec.name}': mimic names '{end}', not a movable joint of {urdf.path}")
        given = by_name[name].mimic
        wanted = (coupling.joint, coupling.multiplier, coupling.offset)
        if given is not None and given != wanted:
            raise HandError(
                f"hand '{spec.name}': mimic couples '{name}' to {_coupling_text(wanted)}, but {urdf.path} couples it "
                f"to {_coupling_text(given)}; leave it out of hand.yaml, or change the URDF"
            )
    joints = tuple(
        replace(j, mimic=(m.joint, m.multiplier, m.offset)) if (m := spec.mimic.get(j.name)) else j for j in urdf.joints
    )
    check_mimic(urdf.path, joints)
    return replace(urdf, joints=joints)


def _coupling_text(mimic: tuple[str, float, float]) -> str:
    return f"{mimic[1]:g} x '{mimic[0]}'" + (f" {mimic[2]:+g}" if mimic[2] else "")


def _own_limits(joints: list[Joint]) -> np.ndarray:
    return np.array([(j.lower, j.upper) for j in joints], np.float32).reshape(-1, 2)


def _check_shared(spec: HandSpec, moving: list[Joint], urdf: Urdf) -> tuple[str, ...]:
    free = {j.name for j in moving if j.mimic is None}
    for name, values in spec.shared.items():
        if name not in free:
            raise HandError(
                f"hand '{spec.name}': shared joint '{name}' is not a joint of {urdf.path} that moves by itself"
            )
        if not values:
            raise HandError(f"hand '{spec.name}': shared joint '{name}' has no values; list some or lock it")
    number = int(np.prod([len(values) for values in spec.shared.values()]))
    if number > MAX_SETTINGS:
        raise HandError(
            f"hand '{spec.name}': the values of its shared joints make {number} settings, at most {MAX_SETTINGS} are "
            "supported; list fewer"
        )
    if len(spec.shared) == len(free):
        raise HandError(f"hand '{spec.name}': every joint of {urdf.path} is locked or shared; leave some to move")
    return tuple(spec.shared)


def _settings(
    spec: HandSpec,
    shared: tuple[str, ...],
    column: dict[str, int],
    opened: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
) -> np.ndarray:
    rows = []
    for values in itertools.product(*(spec.shared[name] for name in shared)):
        row = opened.copy()
        for name, value in zip(shared, values, strict=True):
            k = column[name]
            if not lower[k] - 1e-4 <= value <= upper[k] + 1e-4:
                raise HandError(
                    f"hand '{spec.name}': shared joint '{name}' = {value} is outside its limits "
                    f"[{lower[k]:g}, {upper[k]:g}]"
                )
            row[k] = min(max(value, lower[k]), upper[k])
        rows.append(row)
    return np.array(rows, np.float32)


def _group(
    moving: list[Joint],
    parent_of: dict[str, str | None],
    drive: dict[str, tuple[str, float, float]],
    shared: tuple[str, ...],
) -> list[list[Joint]]:
    """Connected components: joints that share an ancestor joint, or a source that is not one of the shared joints.

    Joints driven by a shared one join no groups; each group gets a copy of those below which its joints are mounted.
    """
    by_name = {j.name: j for j in moving}
    framing = {j.name for j in moving if drive[j.name][0] in shared}
    label = {j.name: j.name for j in moving if j.name not in framing}

    def find(name: str) -> str:
        while label[name] != name:
            name = label[name]
        return name

    for name in label:
        up = parent_of[name]
        while up is not None and up in framing:
            up = parent_of[up]
        for other in (up, drive[name][0]):
            if other is not None:
                label[find(name)] = find(other)
    members: dict[str, set[str]] = {}
    for name in label:
        members.setdefault(find(name), set()).add(name)
    for names in members.values():
        for name in list(names):
            up = parent_of[name]
            while up is not None:
                names.add(up)
                up = parent_of[up]
    # links on framing joints that carry no finger go with the first group
    first = next(iter(members.values()))
    for name in framing - set().union(*members.values()):
        up: str | None = name
        while up is not None:
            first.add(up)
            up = parent_of[up]
    position = {name: i for i, name in enumerate(by_name)}
    return [[by_name[n] for n in sorted(names, key=position.__getitem__)] for names in members.values()]


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
    actuated: list[Joint], moving: list[Joint], drive: dict[str, tuple[str, float, float]], spec: HandSpec
) -> tuple[np.ndarray, np.ndarray]:
    """Limits of the actuated joints [rad or m], narrowed so that every mimic joint stays inside its own."""
    lower = {j.name: j.lower for j in actuated}
    upper = {j.name: j.upper for j in actuated}
    for j in moving:
        source, mult, offset = drive[j.name]
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
