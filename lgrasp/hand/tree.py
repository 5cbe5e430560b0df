"""Joint tree -> dependency groups, actuated joints and the flat tables of the Warp forward kinematics."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lgrasp.errors import HandError
from lgrasp.hand.couplings import drive_limits, find_drives, with_mimic
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.urdf import Joint, Urdf
from lgrasp.math.constants import LIMIT_EXCESS
from lgrasp.math.limits import DOF_SIZES, MAX_DOFS

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
    joint_effort: np.ndarray  # (K,) what each presses with at most [N m or N]; infinite: no limit
    joint_open: np.ndarray  # (K,) the open posture
    joint_first: np.ndarray  # (G + 1,) i32
    dof_first: np.ndarray  # (G + 1,) i32
    joint_parent: np.ndarray  # (J,) i32, inside the group, -1 = base
    joint_dof: np.ndarray  # (J,) i32, inside the group
    joint_mult: np.ndarray  # (J,)
    joint_offset: np.ndarray  # (J,)
    joint_axis: np.ndarray  # (J, 3)
    joint_prismatic: np.ndarray  # (J,) i32
    drive_prismatic: np.ndarray  # (J,) i32: of the actuated joint that each follows, or is
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
    def dof_size(self) -> int:
        """The size that its kernels are compiled for: one of DOF_SIZES, not less than the dofs of any group."""
        return next(size for size in DOF_SIZES if size >= np.diff(self.dof_first).max())

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

    def own_dofs(self, group: int) -> np.ndarray:
        """Columns of the joints that a group moves and no other does."""
        return self.dof_index[self.dof_first[group] : self.dof_first[group] + self.dof_free[group]]

    def by_group(self, q: np.ndarray) -> np.ndarray:
        """Actuated joints q, shape [n, K], by group as kernels take them, shape [n, G, MAX_DOFS]."""
        out = np.zeros((len(q), self.groups, MAX_DOFS), q.dtype)
        for g in range(self.groups):
            columns = self.dof_index[self.dof_first[g] : self.dof_first[g + 1]]
            out[:, g, : len(columns)] = q[:, columns]
        return out

    @property
    def groups(self) -> int:
        return len(self.joint_first) - 1

    @cached_property
    def dof_shared(self) -> np.ndarray:
        """(D,) i32: which of the shared joints each dof is, -1 for a group's own."""
        place = {self.joint_names.index(name): i for i, name in enumerate(self.shared_names)}
        return np.array([place.get(int(column), -1) for column in self.dof_index], np.int32)

    @cached_property
    def body_group(self) -> np.ndarray:
        """(1 + J,) i32: group of each body, -1 for the base."""
        return np.concatenate([[-1], np.repeat(np.arange(self.groups), np.diff(self.joint_first))]).astype(np.int32)

    @cached_property
    def body_parent(self) -> np.ndarray:
        """(1 + J,) i32: body that each is mounted on, -1 for the base."""
        mounted = 1 + self.joint_parent + self.joint_first[self.body_group[1:]]
        return np.concatenate([[-1], np.where(self.joint_parent < 0, 0, mounted)]).astype(np.int32)

    @cached_property
    def joint_column(self) -> np.ndarray:
        """(J,) i32: column of q that drives each joint."""
        return self.dof_index[self.dof_first[self.body_group[1:]] + self.joint_dof]

    @cached_property
    def column_sliding(self) -> np.ndarray:
        """(K,) i32: 1 for actuated joints that slide."""
        out = np.zeros(len(self.joint_names), np.int32)
        out[self.joint_column] = self.drive_prismatic
        return out

    def path(self, body: int) -> list[int]:
        """Bodies from the base (left out) to a body."""
        return [*self.path(int(self.body_parent[body])), body] if body > 0 else []

    def moving_joints(self, body: int) -> np.ndarray:
        """(K,) bool: actuated joints that move a body, shared ones included."""
        return np.isin(np.arange(len(self.joint_names)), self.joint_column[np.array(self.path(body), int) - 1])

    def body_of(self, link: str) -> int:
        """Body that a link rides on."""
        return int(self.link_body[self.link_names.index(link)])

    def group_of(self, link: str) -> int:
        """Group that a link belongs to, -1 for static ones."""
        return int(self.body_group[self.body_of(link)])

    @property
    def link_groups(self) -> np.ndarray:
        """(L,) i32: group of each link, -1 for static ones."""
        return self.body_group[self.link_body]

    def surface_of(self, link: str) -> int:
        """Group of a link among contact surfaces: that of static links comes last."""
        return self.group_of(link) % (self.groups + 1)

    def links_on(self, body: int) -> list[str]:
        """Links that ride on a body."""
        return [name for name, b in zip(self.link_names, self.link_body, strict=True) if b == body]


def build_tree(urdf: Urdf, spec: HandSpec) -> Tree:
    """Split the hand into static base and dependency groups.

    Groups are the connected components of the tree without static links; a mimic joint joins the group of its source.
    Shared joints connect nothing.

    Raises:
        HandError: spec names a joint or link that does not exist, or a locked or shared value is outside the limits.
    """
    stated = {j.name for j in urdf.joints if j.mimic is not None}
    urdf = with_mimic(urdf, spec)
    base = spec.base_link or urdf.root
    _check_names(urdf, spec, base)
    drive = find_drives(urdf)
    fixed = {n: m * spec.locked[source] + b for n, (source, m, b) in drive.items() if source in spec.locked}
    _check_fixed(urdf, spec, fixed)
    # each link: the movable joint it rides on (None = static) and its pose in that joint's moving frame (or the root)
    rides: dict[str, tuple[str | None, np.ndarray]] = {urdf.root: (None, np.eye(4))}
    parent_of: dict[str, str | None] = {}
    pose_of: dict[str, np.ndarray] = {}
    moving: list[Joint] = []
    for j in urdf.joints:
        carrier, T = rides[j.parent]
        T = T @ j.T_parent_joint
        if j.movable and j.name not in fixed:
            parent_of[j.name], pose_of[j.name] = carrier, T
            moving.append(j)
            rides[j.child] = (j.name, np.eye(4))
        else:
            rides[j.child] = (carrier, T @ j.motion(np.array(fixed[j.name])) if j.movable else T)
    if not moving:
        raise HandError(f"hand '{spec.name}': every joint of {urdf.path} is locked; leave some to move")
    # the base frame: the base link must be static
    if rides[base][0] is not None:
        raise HandError(
            f"hand '{spec.name}': base_link '{base}' is moved by joint '{rides[base][0]}'; name a static link"
        )
    T_base_root = np.linalg.inv(rides[base][1])
    rides |= {link: (None, T_base_root @ T) for link, (carrier, T) in rides.items() if carrier is None}
    pose_of |= {name: T_base_root @ pose_of[name] for name, carrier in parent_of.items() if carrier is None}

    shared = _check_shared(spec, moving, urdf)
    groups = _group(moving, parent_of, drive, shared)
    actuated = [j for j in urdf.joints if j in moving and j.mimic is None]
    column = {j.name: i for i, j in enumerate(actuated)}
    dof_first, dof_index, dof_free, joint_dof, joint_parent = [0], [], [], [], []
    body: dict[str, int] = {}
    for members in groups:
        sources = dict.fromkeys(drive[j.name][0] for j in members)
        place = {n: i for i, n in enumerate(sorted(sources, key=shared.__contains__))}  # shared ones last
        local = {j.name: i for i, j in enumerate(members)}
        for j in members:
            up = parent_of[j.name]
            joint_dof.append(place[drive[j.name][0]])
            joint_parent.append(-1 if up is None else local[up])
            # the links of a joint that is in several groups ride with the first
            body.setdefault(j.name, len(joint_dof))
        dof_index += [column[n] for n in place]
        dof_first.append(len(dof_index))
        dof_free.append(len(place.keys() - shared))
    order = [j for members in groups for j in members]
    lower, upper = drive_limits(actuated, moving, drive, spec)
    settings = _settings(spec, column, lower, upper)
    # joints that the URDF by itself would leave at 0: locked ones, and those that only hand.yaml couples
    unstated = [j for j in urdf.joints if j.mimic is not None and j.name not in stated]
    locked = [j for j in urdf.joints if j.name in fixed and (j.name in spec.locked or j in unstated)]
    coupled = [j for j in unstated if j.name not in fixed]
    coupling = [drive[j.name] for j in coupled]
    taken = {name: [value] for name, value in fixed.items()}
    taken |= {
        j.name: [mult * end[column[source]] + offset for end in (lower, upper)]
        for j, (source, mult, offset) in zip(coupled, coupling, strict=True)
    }
    return Tree(
        base_link=base,
        joint_names=tuple(j.name for j in actuated),
        joint_lower=lower.astype(np.float32),
        joint_upper=upper.astype(np.float32),
        joint_effort=np.array([j.effort for j in actuated], np.float32),
        joint_open=settings[0],
        joint_first=np.cumsum([0, *(len(m) for m in groups)]).astype(np.int32),
        dof_first=np.array(dof_first, np.int32),
        joint_parent=np.array(joint_parent, np.int32),
        joint_dof=np.array(joint_dof, np.int32),
        joint_mult=np.array([drive[j.name][1] for j in order], np.float32),
        joint_offset=np.array([drive[j.name][2] for j in order], np.float32),
        joint_axis=np.array([j.axis for j in order], np.float32),
        joint_prismatic=np.array([j.prismatic for j in order], np.int32),
        drive_prismatic=np.array([actuated[column[drive[j.name][0]]].prismatic for j in order], np.int32),
        T_parent_joint=np.array([pose_of[j.name] for j in order]),
        dof_index=np.array(dof_index, np.int32),
        dof_free=np.array(dof_free, np.int32),
        shared_names=shared,
        settings=settings,
        locked_names=tuple(j.name for j in locked),
        locked_values=np.array([fixed[j.name] for j in locked], np.float32),
        locked_limits=_own_limits(locked, taken),
        coupled_names=tuple(j.name for j in coupled),
        coupled_column=np.array([column[source] for source, _, _ in coupling], np.int32),
        coupled_mult=np.array([mult for _, mult, _ in coupling], np.float32),
        coupled_offset=np.array([offset for _, _, offset in coupling], np.float32),
        coupled_limits=_own_limits(coupled, taken),
        link_names=tuple(urdf.links),
        link_body=np.array([0 if (c := rides[n][0]) is None else body[c] for n in urdf.links], np.int32),
        T_body_link=np.array([rides[n][1] for n in urdf.links]),
    )


def _check_names(urdf: Urdf, spec: HandSpec, base: str) -> None:
    """The joints and links that the rules name exist."""
    movable = {j.name: j for j in urdf.joints if j.movable}
    for name in spec.locked:
        joint = movable.get(name)
        if joint is None:
            raise HandError(f"hand '{spec.name}': locked joint '{name}' is not a movable joint of {urdf.path}")
        if joint.mimic is not None:
            source = f"follows joint '{joint.mimic[0]}'; lock that one instead"
            raise HandError(f"hand '{spec.name}': joint '{name}' is locked but {source}")
    for name in spec.open_posture:
        if name not in movable:
            raise HandError(f"hand '{spec.name}': open_posture names '{name}', not a movable joint of {urdf.path}")
    for link in (*spec.static_links, *itertools.chain(*spec.fingers.values())):
        if link not in urdf.links:
            raise HandError(f"hand '{spec.name}': '{link}' (static_links or fingers) is not a link of {urdf.path}")
    if base not in urdf.links:
        raise HandError(f"hand '{spec.name}': base_link '{base}' is not a link of {urdf.path}")


def _check_fixed(urdf: Urdf, spec: HandSpec, fixed: dict[str, float]) -> None:
    """Locked joints, and those that follow them, may be where they are held."""
    for joint in urdf.joints:
        value = fixed.get(joint.name, joint.lower)
        which, excess = "joint that follows a locked one,", LIMIT_EXCESS
        if joint.name in spec.locked:
            which, excess = "locked joint", 1e-6
        free = joint.continuous and joint.name not in spec.locked
        if not free and not joint.lower - excess <= value <= joint.upper + excess:
            raise HandError(
                f"hand '{spec.name}': {which} '{joint.name}' = {value:g} is outside its limits "
                f"[{joint.lower:g}, {joint.upper:g}]"
            )


def _own_limits(joints: list[Joint], taken: dict[str, list[float]]) -> np.ndarray:
    """Limits [rad or m], (n, 2) f32; those of continuous joints hold what they take."""
    ends = [[j.lower, j.upper, *(taken[j.name] if j.continuous else ())] for j in joints]
    return np.array([(min(x), max(x)) for x in ends], np.float32).reshape(-1, 2)


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


def _settings(spec: HandSpec, column: dict[str, int], lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The open posture with the shared joints at each combination of their values, (V, K) f32."""
    names = list(column)
    opened = np.clip([spec.open_posture.get(name, 0.0) for name in names], lower, upper)
    for name, values in spec.shared.items():
        low, high = lower[column[name]], upper[column[name]]
        for value in values:
            if not low - 1e-4 <= value <= high + 1e-4:
                limits = f"[{low:g}, {high:g}]"
                raise HandError(f"hand '{spec.name}': shared joint '{name}' = {value} is outside its limits {limits}")
    rows = np.array([[*opened]] * int(np.prod([len(values) for values in spec.shared.values()])))
    columns = [column[name] for name in spec.shared]
    rows[:, columns] = list(itertools.product(*spec.shared.values()))
    return np.clip(rows, lower, upper).astype(np.float32)


def _group(
    moving: list[Joint],
    parent_of: dict[str, str | None],
    drive: dict[str, tuple[str, float, float]],
    shared: tuple[str, ...],
) -> list[list[Joint]]:
    """Connected components: joints that share an ancestor joint, or a source that is not one of the shared joints.

    Joints driven by a shared one join no groups; each group gets a copy of those below which its joints are mounted.
    """
    framing = {j.name for j in moving if drive[j.name][0] in shared}
    label = {j.name: j.name for j in moving if j.name not in framing}

    def above(name: str) -> Iterator[str]:
        up = parent_of[name]
        while up is not None:
            yield up
            up = parent_of[up]

    def find(name: str) -> str:
        while label[name] != name:
            name = label[name]
        return name

    for name in label:
        for other in (next((up for up in above(name) if up not in framing), name), drive[name][0]):
            label[find(name)] = find(other)
    members: dict[str, set[str]] = {}
    for name in label:
        members.setdefault(find(name), set()).update((name, *above(name)))
    # links on framing joints that carry no finger go with the first group
    first = next(iter(members.values()))
    for name in framing - set().union(*members.values()):
        first.update((name, *above(name)))
    return [[j for j in moving if j.name in names] for names in members.values()]
