"""All checks on rows of one shard; every number is derived from the URDF, the object meshes and the row alone."""

import itertools
import math
from collections import Counter

import numpy as np
from scipy.spatial.transform import Rotation

from lgrasp.judge import bounds
from lgrasp.judge.collision import PlacedSolids, hand_in_object, object_in_object
from lgrasp.judge.hand import pose_transforms
from lgrasp.judge.meshes import PROBES
from lgrasp.judge.shard import JudgedShard, in_range
from lgrasp.judge.solids import on_links
from lgrasp.judge.steer import Asked, disobeys, on_table
from lgrasp.judge.wrench import ferrari_canny, force_errors, wrench_residual

CHECKS: dict[str, tuple[str, float]] = {
    "finite": ("", 0.0),
    "indices": ("", 0.0),
    "limits": ("limit_excess", bounds.LIMIT_EXCESS),
    "mimic": ("mimic_error", bounds.LIMIT_EXCESS),
    "mimic_limits": ("mimic_limit_excess", bounds.LIMIT_EXCESS),
    "penetration": ("penetration_mm", 1e3 * bounds.PENETRATION),
    "pregrasp": ("pregrasp_mm", 1e3 * bounds.PENETRATION),
    "self_penetration": ("self_penetration_mm", 1e3 * bounds.SELF_PENETRATION),
    "closing": ("closing_mm", 1e3 * bounds.SELF_PENETRATION),
    "contact_on_object": ("contact_object_mm", 1e3 * bounds.CONTACT_DISTANCE),
    "contact_on_link": ("contact_link_mm", 1e3 * bounds.CONTACT_DISTANCE),
    "normal": ("normal_deg", bounds.NORMAL_DEG),
    "stored_normal": ("stored_normal_deg", bounds.NORMAL_DEG),
    "residual": ("residual", bounds.RESIDUAL),
    "forces": ("force_error", bounds.RESIDUAL),
    "object_object": ("object_object_mm", 1e3 * bounds.PENETRATION),
    "table": ("below_table_mm", 0.0),
    "resting": ("resting_gap_mm", 1e3 * bounds.RESTING_GAP),
    "approach": ("approach_mm", 1e3 * bounds.PENETRATION),
    "touch": ("touch_missing", bounds.SHARE_TOLERANCE),
    "avoid": ("avoid_contacts", 0.0),
    "steered": ("", 0.0),
    "frozen": ("", 0.0),
    "parent": ("", 0.0),
}
"""The strict checks by name, each with the value it bounds ('' for a check of form) and the bound."""

VALUES = (
    *(value for value, _ in CHECKS.values() if value),
    *("object_in_link_mm", "link_in_object_mm", "residual_stored_normals", "residual_frictionless"),
    *("force_balance", "force_normal_sum_error", "force_cone_excess", "contacts", "links_in_contact", "epsilon"),
)
"""The recomputed numbers by name."""


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle in degrees between unit vectors (..., 3), accurate near 0."""
    return np.degrees(2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


class RowChecks:
    """Checks on chosen rows of one shard.

    Attributes:
        values: recomputed numbers by name, (n,) each, NaN where not judged.
        failed: by check, (n,) each. Rows that are not finite or whose indices are wrong fail only that.
        self_pairs: pairs of links with self-penetration beyond the bound, and their rows.
    """

    def __init__(self, shard: JudgedShard, rows: np.ndarray, *, epsilon: bool = False) -> None:
        self.shard, self.hand, self.rows, n = shard, shard.hand, rows, len(rows)
        self.g = {k: v[rows] for k, v in shard.grasps.items()}
        self.values = {k: np.full(n, np.nan) for k in VALUES}
        self.failed = {k: np.zeros(n, bool) for k in CHECKS}
        self.self_pairs: Counter[str] = Counter()
        self._form()
        bad = self.failed["finite"] | self.failed["indices"]
        good = self.good = np.flatnonzero(~bad)
        if len(good):
            T_links = self.hand.forward(self._joints(), len(good))
            poses = np.asarray(self.g["object_pose"], float)[good]
            T_objects = np.full((*poses.shape[:2], 4, 4), np.nan)
            for o in range(poses.shape[1]):
                here = self.index[good, o] >= 0
                turns = Rotation.from_quat(poses[here, o, 3:], scalar_first=True)
                T_objects[here, o] = pose_transforms(poses[here, o, :3], turns)
            T_closing = self._closing()
            self._self_penetration(T_links, T_closing)
            self._penetration(T_links, T_closing[:1], T_objects)
            self._contacts(T_links, T_objects)
            if shard.table:
                self._table([T_links, *T_closing], T_objects[:, 0])
            self._regions()
            if shard.asked:
                self._steered(shard.asked, T_links, T_objects[:, 0])
            for row in good:
                self._wrenches(int(row), epsilon)
        if shard.steps:
            self.failed["frozen"] = self._frozen() & ~bad
            self.failed["parent"] = self._parents() & ~bad

    def _set(self, check: str, value: np.ndarray) -> None:
        """Numbers of the good rows, in the unit of the check's bound."""
        name, bound = CHECKS[check]
        self.values[name][self.good] = value
        self.failed[check][self.good[~(value <= bound)]] = True

    def _form(self) -> None:
        """Finite numbers, unit quaternions and indices that exist."""
        g = self.g
        self.index = np.asarray(g["object_index"], int)
        links = np.asarray(g["contact_links"], int)
        present = self.index >= 0
        self.used = (links >= 0) & present[..., None]  # (n, O, C)
        pose = np.asarray(g["object_pose"], float)
        with np.errstate(invalid="ignore", over="ignore"):
            unit = np.abs(np.linalg.norm(pose[..., 3:], axis=-1) - 1.0) <= bounds.UNIT_QUATERNION
        bad = (present & ~(in_range(pose).all(axis=-1) & unit)).any(axis=1)
        for name in ("q", "q_pregrasp", "q_squeeze"):
            if name in g:
                bad |= ~in_range(g[name]).all(axis=1)
        for name in ("contact_points", "contact_normals", "contact_forces"):
            if name in g:
                bad |= (self.used & ~in_range(g[name]).all(axis=-1)).any(axis=(1, 2))
        self.failed["finite"] = bad
        names = self.shard.link_names
        known = np.array([self.hand.index.get(name, -1) for name in names] + [-1])
        self.link_of = known[np.where((links >= 0) & (links < len(names)), links, len(names))]
        absent = (self.index >= len(self.shard.objects)).any(axis=1) | ~present.any(axis=1)
        self.failed["indices"][:] = (self.used & (self.link_of < 0)).any(axis=(1, 2)) | absent
        if self.shard.table:
            self._form_of_table()

    def _form_of_table(self) -> None:
        """Tables that exist, and directions of unit length."""
        self.table = {k: np.asarray(v[self.rows], float) for k, v in self.shard.table.items()}
        with np.errstate(invalid="ignore", over="ignore"):
            unit = np.abs(np.linalg.norm(self.table["approach"], axis=1) - 1.0) <= bounds.UNIT_NORMAL
        self.failed["finite"] |= ~unit
        tables = np.array([len(t) for t in self.shard.tables] + [0])
        known = tables[np.clip(self.index[:, 0], -1, len(tables) - 1)]
        pose = self.table["pose"]
        self.failed["indices"] |= (
            ~((pose >= 0) & (pose < known)) | (self.index.shape[1] > 1) | ("q_pregrasp" not in self.g)
        )

    def _joints(self) -> dict[str, np.ndarray]:
        """Limits, mimic relations and couplings, of the open hand too; values of all joints at the grasp."""
        own, driven, relation = (np.zeros(len(self.good)) for _ in range(3))
        postures = {name: self._full(name) for name in ("q", "q_pregrasp") if name in self.g}
        for posture, full in postures.items():
            stored = self._values(posture)
            for name, j in self.hand.movable.items():
                excess = np.maximum(np.maximum(j.lower - full[name], full[name] - j.upper), 0.0)
                if j.mimic is None:
                    own = np.maximum(own, excess)
                else:
                    driven = np.maximum(driven, excess)
                    relation = np.maximum(relation, np.abs(stored.get(name, full[name]) - full[name]))
            for name, (of, multiplier, offset) in self.shard.couplings.items():
                relation = np.maximum(relation, np.abs(full[name] - multiplier * full[of] - offset))
        self._set("limits", own)
        self._set("mimic_limits", driven)
        self._set("mimic", relation)
        return postures["q"]

    def _values(self, posture: str) -> dict[str, np.ndarray]:
        return dict(zip(self.shard.joint_names, np.asarray(self.g[posture], float)[self.good].T, strict=True))

    def _full(self, posture: str) -> dict[str, np.ndarray]:
        """Values of all joints."""
        return self.hand.resolve_joints(self._values(posture), len(self.good))

    def _closing(self) -> list[np.ndarray]:
        """Poses of the links at ``q_pregrasp`` and on the straight way to ``q``, (n, L, 4, 4) each; of no open hand
        none."""
        if "q_pregrasp" not in self.g:
            return []
        before, q = self._full("q_pregrasp"), self._full("q")
        ways = [{name: (1 - t) * before[name] + t * q[name] for name in q} for t in (0.0, *bounds.CLOSING)]
        return [self.hand.forward(way, len(self.good)) for way in ways]

    def _table(self, T_hand: list[np.ndarray], T_objects: np.ndarray) -> None:
        """The hand above the table at the grasp, before it and along the way; the way clear of the object.

        Args:
            T_hand: poses of the links at the grasp, open, and while they close.
        """
        good, hand = self.good, self.hand
        pose, back = self.table["pose"][good].astype(int), -self.table["approach"][good]
        found = np.zeros((3, len(good)))
        for k, obj in enumerate(self.shard.objects):
            m = np.flatnonzero(self.index[good, 0] == k)
            planes = self.shard.tables[k][pose[m]]
            grasp, opened, *closing = (T[m] for T in T_hand)
            found[:, m] = on_table(hand, obj, planes, T_objects[m], [grasp, *closing], opened, back[m])
        if self.shard.asked and self.shard.asked.plane is not None:
            found[1] = 0.0  # a plane that a user asks for need not touch the object
        for check, value in zip(("table", "resting", "approach"), found, strict=True):
            self._set(check, 1e3 * value)

    def _regions(self) -> None:
        """Contacts where the objects' regions ask for them, and nowhere else."""
        for o, (k, regions) in itertools.product(range(self.index.shape[1]), enumerate(self.shard.regions)):
            rows = np.flatnonzero(self.index[self.good, o] == k)
            if regions is None or not len(rows):
                continue
            r = self.good[rows]
            points, normals = (np.asarray(self.g[name], float)[r, o] for name in ("contact_points", "contact_normals"))
            forces = np.asarray(self.g["contact_forces"], float)[r, o] if "contact_forces" in self.g else 0.0 * normals
            for check, value in zip(
                ("touch", "avoid"), regions.judge(points, normals, forces, self.used[r, o]), strict=True
            ):
                own = self.values[CHECKS[check][0]][self.good]
                own[rows] = np.fmax(own[rows], value)
                self._set(check, np.nan_to_num(own))

    def _steered(self, asked: Asked, T_links: np.ndarray, T_objects: np.ndarray) -> None:
        """Rows that do not obey what was asked of them."""
        shard, good, planes = self.shard, self.good, None
        if shard.table:
            pairs = zip(self.index[good, 0], self.table["pose"][good].astype(int), strict=True)
            planes = np.array([shard.tables[k][pose] for k, pose in pairs])
        links = np.where(self.used[good], np.asarray(self.g["contact_links"])[good], -1).reshape(len(good), -1)
        normals = self.link_normals[good].reshape(*links.shape, -1, 3)
        thumb = self.hand.index.get(asked.thumb.link) if asked.thumb else None
        T_thumb = T_links[:, thumb] if thumb is not None else np.full_like(T_objects, np.nan)
        found = disobeys(asked, shard.link_names, links, normals, T_thumb, T_objects, planes)
        self.failed["steered"][good] = found

    def _self_penetration(self, T_links: np.ndarray, T_closing: list[np.ndarray]) -> None:
        depth, self.self_pairs = self._links_in_links(T_links)
        self._set("self_penetration", 1e3 * depth)
        if T_closing:
            self._set("closing", 1e3 * np.max([self._links_in_links(T)[0] for T in T_closing], axis=0))

    def _links_in_links(self, T_links: np.ndarray) -> tuple[np.ndarray, Counter[str]]:
        """Deepest penetration of links [m], (n,), and in how many rows which pairs are beyond the bound."""
        hand, depth = self.hand, np.zeros(len(self.good))
        poses = PlacedSolids(hand.solids, T_links)
        beyond: dict[str, set[int]] = {}
        for a, b in hand.pairs:
            for i in np.flatnonzero(~poses.far(a, b)).tolist():
                d = poses.depth(i, a, b, bounds.SELF_PENETRATION)
                depth[i] = max(depth[i], d)
                if d > bounds.SELF_PENETRATION:
                    name = " x ".join(sorted(hand.links[hand.solids[k].link] for k in (a, b)))
                    beyond.setdefault(name, set()).add(i)
        return depth, Counter({k: len(v) for k, v in beyond.items()})

    def _penetration(self, T_links: np.ndarray, T_open: list[np.ndarray], T_objects: np.ndarray) -> None:
        in_link, in_object = self._hand_in_objects(T_links, T_objects)
        self.values["object_in_link_mm"][self.good] = 1e3 * in_link
        self.values["link_in_object_mm"][self.good] = 1e3 * in_object
        self._set("penetration", 1e3 * np.maximum(in_link, in_object))
        for T in T_open:
            self._set("pregrasp", 1e3 * np.max(self._hand_in_objects(T, T_objects), axis=0))
        if T_objects.shape[1] > 1:
            self._between_objects(T_objects)

    def _hand_in_objects(self, T_links: np.ndarray, T_objects: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Deepest point of any object in a link, and of a link in any object [m], of the good rows."""
        index = self.index[self.good]
        in_link, in_object = (np.zeros(len(index)) for _ in range(2))
        for o, (k, obj) in itertools.product(range(index.shape[1]), enumerate(self.shard.objects)):
            rows = np.flatnonzero(index[:, o] == k)
            if len(rows):
                T = np.linalg.inv(T_objects[rows, o])[:, None] @ T_links[rows]
                a, b = hand_in_object(self.hand, obj, T)
                in_link[rows], in_object[rows] = np.maximum(in_link[rows], a), np.maximum(in_object[rows], b)
        return in_link, in_object

    def _between_objects(self, T_objects: np.ndarray) -> None:
        index, between = self.index[self.good], np.zeros(len(self.good))
        objects = self.shard.objects
        for a, b in itertools.combinations(range(index.shape[1]), 2):
            for i in np.flatnonzero((index[:, a] >= 0) & (index[:, b] >= 0)):
                T = (np.linalg.inv(T_objects[i, a]) @ T_objects[i, b])[None]
                depth = object_in_object(objects[index[i, a]], objects[index[i, b]], T)
                between[i] = max(between[i], depth[0])
        self._set("object_object", 1e3 * between)

    def _contacts(self, T_links: np.ndarray, T_objects: np.ndarray) -> None:
        """Contact distances and normals; keeps the recomputed outward object normals for the wrenches, and the links'
        (link frame)."""
        self.normals = np.full((*self.used.shape, 3), np.nan)
        i, o, c = np.nonzero(self.used[self.good])
        r = self.good[i]
        points, given = (np.asarray(self.g[k], float)[r, o, c] for k in ("contact_points", "contact_normals"))
        object_normals, on_object = np.zeros((len(r), len(PROBES) + 1, 3)), np.zeros(len(r))
        for k, obj in enumerate(self.shard.objects):
            m = np.flatnonzero(self.index[r, o] == k)
            on_object[m] = obj.surface.closest(points[m])[0]
            object_normals[m] = obj.surface.normals(points[m])
        links = self.link_of[r, o, c]
        T = np.linalg.inv(T_objects[i, o]) @ T_links[i, links]  # object from link
        local = np.einsum("nji,nj->ni", T[:, :3, :3], points - T[:, :3, 3])
        on_link, link_normals = on_links(self.hand.solids, links, local, -np.einsum("nji,nj->ni", T[:, :3, :3], given))
        self.link_normals = np.full((*self.used.shape, *link_normals.shape[1:]), np.nan)
        self.link_normals[r, o, c] = link_normals
        link_normals = np.einsum("nij,npj->npi", T[:, :3, :3], link_normals)
        between = angle_deg(-link_normals[:, :, None], object_normals[:, None])  # (n, P, P)
        length = np.linalg.norm(given, axis=1, keepdims=True)
        off = angle_deg((given / np.maximum(length, 1e-12))[:, None], object_normals).min(axis=1)
        off = np.where(np.abs(length[:, 0] - 1.0) <= bounds.UNIT_NORMAL, off, 180.0)
        found = {"contact_on_object": 1e3 * on_object, "contact_on_link": 1e3 * np.abs(on_link)}
        for check, each in (found | {"normal": between.min(axis=(1, 2)), "stored_normal": off}).items():
            worst = np.zeros(len(self.good))
            np.maximum.at(worst, i, each)
            self._set(check, worst)
        # the wrench uses the mesh normal; on an edge or vertex, the admissible one nearest the link's
        nominal = between[:, :, 0].min(axis=1) <= bounds.NORMAL_DEG
        chosen = np.where(nominal, 0, between.min(axis=1).argmin(axis=1))
        self.normals[r, o, c] = object_normals[np.arange(len(r)), chosen]

    def _wrenches(self, row: int, epsilon: bool) -> None:
        """Of several objects the worst; an object without contacts is held by nothing."""
        found: dict[str, list[float]] = {}
        links = []
        for o in np.flatnonzero(self.index[row] >= 0):
            used = self.used[row, o]
            links.append(self.link_of[row, o, used])
            points, stored = (np.asarray(self.g[k], float)[row, o, used] for k in ("contact_points", "contact_normals"))
            inward = -self.normals[row, o, used]
            numbers = {"residual": math.inf}
            if used.any():
                given = -stored / np.maximum(np.linalg.norm(stored, axis=1, keepdims=True), 1e-12)
                numbers = {
                    "residual": wrench_residual(points, inward)[0],
                    "residual_frictionless": wrench_residual(points, inward, mu=0.0)[0],
                    "residual_stored_normals": wrench_residual(points, given)[0],
                }
            if used.any() and "contact_forces" in self.g:
                names = ("force_balance", "force_normal_sum_error", "force_cone_excess")
                forces = np.asarray(self.g["contact_forces"], float)[row, o, used]
                errors = force_errors(points, given, forces, self.shard.friction)
                numbers |= dict(zip(names, errors, strict=True)) | {"force_error": max(errors)}
            if used.any() and epsilon:
                obj = self.shard.objects[self.index[row, o]]
                numbers["epsilon"] = -ferrari_canny(points, inward, obj.centre_of_mass, obj.radius, self.shard.friction)
            for name, value in numbers.items():
                found.setdefault(name, []).append(value)
        for name, each in found.items():
            self.values[name][row] = max(each)
        self.values["epsilon"][row] *= -1.0
        self.failed["residual"][row] = not self.values["residual"][row] <= bounds.RESIDUAL
        self.failed["forces"][row] = self.values["force_error"][row] > bounds.RESIDUAL  # False where none are stored
        self.values["contacts"][row] = sum(len(x) for x in links)
        self.values["links_in_contact"][row] = len(np.unique(np.concatenate(links)))

    def _frozen(self) -> np.ndarray:
        """Rows (n,) whose steps move a joint that is not theirs, or that carries a link on an earlier object."""
        steps, g, index = {k: v[self.rows] for k, v in self.shard.steps.items()}, self.g, self.index
        present, free = index >= 0, np.asarray(steps["free_joints"], bool)  # (n, O), (n, O, K)
        bad = (present[:, 1:] & ~present[:, :-1]).any(axis=1) | (free.sum(axis=1) > 1).any(axis=1)
        bad |= (free.any(axis=2) != present).any(axis=1)
        last = np.maximum(present.sum(axis=1) - 1, 0)
        still = present[:, 1:, None] & ~free[:, 1:]
        for name, held in (("q", "q"), ("q_pregrasp", "q"), ("q_squeeze", "q_squeeze")):
            bad |= (still & (steps[name][:, 1:] != steps[held][:, :-1])).any(axis=(1, 2))
            bad |= (steps[name][np.arange(len(last)), last] != g[name]).any(axis=1) if name in g else False
        riders = self.hand.riders(self.shard.joint_names)  # (K, L)
        for o in range(index.shape[1] - 1):
            later = free[:, o + 1 :].any(axis=1)  # (n, K)
            carried = later.astype(int) @ riders.astype(int) > 0  # (n, L)
            bad |= (np.take_along_axis(carried, np.maximum(self.link_of[:, o], 0), 1) & self.used[:, o]).any(axis=1)
        return bad

    def _parents(self) -> np.ndarray:
        """Rows (n,) of several objects that do not extend an earlier row of one object less bit by bit."""
        g, steps = self.shard.grasps, self.shard.steps
        count, parent = (np.asarray(g["object_index"]) >= 0).sum(axis=1), np.asarray(steps["parent"], int)
        names = ("object_index", "object_pose", "contact_points", "contact_normals", "contact_links", "contact_forces")
        columns = [g[k] for k in names if k in g] + [v for k, v in steps.items() if k != "parent"]
        bad = np.zeros(len(self.rows), bool)
        for i, r in enumerate(self.rows):
            p, n = parent[r], count[r] - 1
            good = p == -1 if n == 0 else 0 <= p < r and count[p] == n
            if good and n > 0:
                good = all(v[r, :n].tobytes() == v[p, :n].tobytes() for v in columns)
            bad[i] = not (good and len(np.unique(steps["space"][r, : n + 1])) == n + 1)
        return bad
