"""Forward kinematics of a URDF: where links are, which joints move them, values of mimic joints."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from lgrasp.judge.urdf import UrdfJoint


def inverse(T: np.ndarray) -> np.ndarray:
    """Inverse of rigid transforms (..., 4, 4)."""
    out = np.zeros_like(T)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = Rt
    out[..., :3, 3] = -(Rt @ T[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def pose_transforms(pose: np.ndarray) -> np.ndarray:
    """Poses (n, 7) x y z qw qx qy qz as transforms (n, 4, 4)."""
    w, x, y, z = (pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)).T
    T = np.zeros((len(pose), 4, 4))
    T[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1)
    T[:, 1, :3] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1)
    T[:, 2, :3] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    T[:, :3, 3], T[:, 3, 3] = pose[:, :3], 1.0
    return T


class LinkTree:
    """Links and joints of a URDF; poses are in the frame of the base link.

    Raises:
        ValueError: a base link or a mimicked joint that is not there, joints outside the tree, mimics in a circle.
    """

    def __init__(self, links: Sequence[str], joints: Sequence[UrdfJoint], base: str | None) -> None:
        self.links, self.joints = list(links), list(joints)
        self.index = {n: i for i, n in enumerate(links)}
        self.movable = {j.name: j for j in joints if j.kind != "fixed"}
        self.actuated = [j for j in self.movable.values() if j.mimic is None]
        children = {j.child for j in joints}
        self.root = next((n for n in links if n not in children), "")
        self.base = base or self.root
        if self.base not in self.index:
            raise ValueError(f"base link {self.base!r} is not in the URDF: {', '.join(links)}")
        self.order = self._order()
        for joint in self.movable.values():
            self._driver(joint)

    def _order(self) -> list[UrdfJoint]:
        done, order, waiting = {self.root}, [], list(self.joints)
        while waiting:
            ready = [j for j in waiting if j.parent in done and j.child in self.index]
            if not ready:
                raise ValueError(f"joints outside the tree: {', '.join(j.name for j in waiting)}")
            order += ready
            done |= {j.child for j in ready}
            waiting = [j for j in waiting if j.child not in done]
        return order

    def _driver(self, joint: UrdfJoint, columns: Sequence[str] = ()) -> UrdfJoint:
        """The joint that a joint follows in the end, or the first on the way of the given names."""
        for _ in range(len(self.movable)):
            if joint.mimic is None or joint.name in columns:
                return joint
            if joint.mimic[0] not in self.movable:
                raise ValueError(f"joint {joint.name!r} mimics {joint.mimic[0]!r}, which is no movable joint")
            joint = self.movable[joint.mimic[0]]
        raise ValueError(f"joint {joint.name!r} mimics itself")

    def resolve_joints(self, values: Mapping[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
        """Values (count,) of all movable joints; mimic joints follow, absent ones rest at 0 clamped to limits."""
        out: dict[str, np.ndarray] = {}

        def value(joint: UrdfJoint) -> np.ndarray:
            if joint.mimic is not None:
                source, multiplier, offset = joint.mimic
                return multiplier * value(self.movable[source]) + offset
            rest = min(max(0.0, joint.lower), joint.upper)
            return np.asarray(values[joint.name], float) if joint.name in values else np.full(count, rest)

        for joint in self.movable.values():
            out[joint.name] = value(joint)
        return out

    def forward(self, q: Mapping[str, np.ndarray], count: int) -> np.ndarray:
        """Poses of the links, (count, L, 4, 4), from every movable joint's values (count,)."""
        T = np.zeros((count, len(self.links), 4, 4))
        T[:, self.index[self.root]] = np.eye(4)
        for j in self.order:
            motion = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
            if j.kind == "prismatic":
                motion[:, :3, 3] = q[j.name][:, None] * j.axis
            elif j.kind != "fixed":
                x, y, z = j.axis
                K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
                s, c = np.sin(q[j.name])[:, None, None], np.cos(q[j.name])[:, None, None]
                motion[:, :3, :3] += s * K + (1.0 - c) * (K @ K)
            T[:, self.index[j.child]] = T[:, self.index[j.parent]] @ (j.T @ motion)
        return inverse(T[:, self.index[self.base]])[:, None] @ T

    def draw(self, count: int) -> np.ndarray:
        """Link poses (count, L, 4, 4) at random postures within the limits, the same every time."""
        rng, q = np.random.default_rng(0), {}
        for j in self.actuated:
            low, high = (j.lower, j.upper) if math.isfinite(j.lower + j.upper) else (-math.pi, math.pi)
            q[j.name] = rng.uniform(low, high, count)
        return self.forward(self.resolve_joints(q, count), count)

    def riders(self, joint_names: Sequence[str]) -> np.ndarray:
        """Which joints of q (K of them) move which links against the base link, also by way of mimics, (K, L)."""
        path: dict[str, frozenset[str]] = {self.root: frozenset()}
        for j in self.order:
            path[j.child] = path[j.parent] | ({j.name} if j.kind != "fixed" else set())
        moves = np.zeros((len(joint_names), len(self.links)), bool)
        for link, name in ((k, name) for k, v in path.items() for name in v ^ path[self.base]):
            driver = self._driver(self.movable[name], joint_names).name
            if driver in joint_names:
                moves[joint_names.index(driver), self.index[link]] = True
        return moves

    def may_meet(self) -> set[tuple[int, int]]:
        """Pairs of links (lower index first) that some joint moves against each other and no joint connects."""
        rigid = {n: n for n in self.links}
        for j in self.order:
            if j.kind == "fixed":
                rigid[j.child] = rigid[j.parent]
        joined = {frozenset((j.parent, j.child)) for j in self.joints}
        return {
            (a, b)
            for b, nb in enumerate(self.links)
            for a, na in enumerate(self.links[:b])
            if rigid[na] != rigid[nb] and frozenset((na, nb)) not in joined
        }
