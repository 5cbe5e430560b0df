"""The local search on a device: matches and gradient steps of many hands, without a graph."""

from typing import Any

import numpy as np
import warp as wp

from lgrasp.differentiable.solids import HandPoints, hand_solids
from lgrasp.errors import HandError
from lgrasp.geometry.poses import device_matrix, device_rotation
from lgrasp.hand.arrays import HandArrays, body_poses, place_bodies
from lgrasp.hand.contact_surface import palm_axis
from lgrasp.hand.tree import Tree
from lgrasp.math.lanes import LANES, lanes_of
from lgrasp.math.scratch import empty_rows
from lgrasp.math.sdf import Grids
from lgrasp.refine.descent_kernels import Moments, Parts, Schedule, advance, descend, penetration
from lgrasp.refine.energy_gradient import MAX_COLUMNS, DescentScratches, Search
from lgrasp.refine.hands import Hands
from lgrasp.refine.match_kernels import (
    DEEPEST,
    LINK_DEEPEST,
    Correspondences,
    Points,
    Solids,
    Surroundings,
    choose_contacts,
    match_links,
    match_points,
    match_solids,
)
from lgrasp.refine.params import LIMIT_SHARE, LocalSearch
from lgrasp.refine.surface import BLOCK, LINK_POINTS, HandSurface, link_probes
from lgrasp.refine.volume import TargetArrays
from lgrasp.runtime.fetch import to_numpy
from lgrasp.runtime.structs import empty_struct, make_struct, upload_struct

_MAX_ADVANCES = 30
_WORKERS = 1 << 13  # hands moved at a time on a GPU: more than it has place for

_DEEP_PENETRATION = 0.002  # [m] hands deeper than this are taken out
_FREE_PENETRATION = 0.0005  # [m] those less deep are out
_STRAIGHT_STEP = 0.002  # [m]
_DIRECTIONS = np.array([w for w in np.ndindex(3, 3, 3) if w != (1, 1, 1)]) - 1.0
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)
_OPENING_SHARES = np.linspace(0.25, 1, 4)  # shares of the way to the open posture
_BACK_STEP, _BACK_FACTOR = 0.004, 4.0  # step [m], and how much farther than straight out an opened hand may go


class Descent:
    """Moves hands by the gradient of E* (:mod:`lgrasp.refine.energy`), without a graph; any number at a time.

    What becomes of a hand does not depend on the others.

    Args:
        surface: the hand's points. solids: its links; default: made here.

    Raises:
        HandError: the hand has too many joints, or no side of it can face an object.
    """

    def __init__(
        self,
        hand: HandArrays,
        target: TargetArrays,
        params: LocalSearch,
        surface: HandSurface,
        solids: HandPoints | None = None,
    ) -> None:
        model = hand.model
        if model.dofs > MAX_COLUMNS:
            raise HandError(
                f"hand '{model.name}' has {model.dofs} joints; the local search takes {MAX_COLUMNS} at most"
            )
        self.params, self._hand, self._target, self.device = params, hand, target, hand.device
        self._points = _points(surface, self.device)
        self._solids = _solids(solids or hand_solids(model, LINK_POINTS), self.device)
        self._bodies = len(model.tree.joint_dof) + 1
        self._search = self._settings(surface)
        self._back = -palm_axis(model)[1]

    def run(self, at: Hands, *, rounds: int | None = None, first: int = 0, whole: int = 0) -> None:
        """Move hands in place: match and take ``gradient_steps`` steps, in rounds ``first`` to ``rounds``.

        Hands deep in the object are first moved out, straight along the shortest of some ways or by opening, within
        ``max_exit_distance``: through a thin wall the gradient leads to either side.

        Args:
            rounds: default: the parameters' ``matching_rounds``.
            whole: rounds along which sizes and reach fall; default: these or the parameters', whichever are more.
        """
        p = self.params
        rounds = p.matching_rounds if rounds is None else rounds
        whole, rows = whole or max(rounds, p.matching_rounds), at.pose.shape[0]
        if rows == 0 or rounds <= first:
            return
        if first == 0 and p.max_exit_distance > 0:
            _resolve_penetration(self, self._hand.model.tree, self._back, at, p.max_exit_distance)
        moments, m, body = self._moments(rows), self._matches(rows), self._body(rows)
        for i in range(first, rounds):
            self._match(at, m, body, p.reach * (p.reach_end / p.reach) ** (i / whole))
            self._descend(at, m, (i - first) * p.gradient_steps, first, whole, False, moments)

    def gradient(self, at: Hands) -> np.ndarray:
        """Derivatives of E* by translation [1/m], rotation about the hand's middle [1/rad] and joints, (N, 6 + K)."""
        rows = at.pose.shape[0]
        m, body, moments = self._matches(rows), self._body(rows), self._moments(rows)
        self._match(at, m, body, self.params.reach)
        self._descend(at, m, 0, 0, 1, True, moments)
        return to_numpy(moments.first)

    def advanced(self, at: Hands, direction: np.ndarray, travel: np.ndarray, clearance: float) -> None:
        """Move hands straight until a point of theirs is ``clearance`` [m] from anything, or by ``travel`` (N,) [m].

        Args:
            direction: unit vectors in the object's frame, (N, 3).
        """
        d, t, rows = self.device, self._target, at.pose.shape[0]
        body = self._body(rows)
        self._place(at, body)
        ways, most = wp.array(direction, dtype=wp.vec3, device=d), wp.array(travel, dtype=wp.float32, device=d)
        inputs = [self._points, t.own, t.around, int(t.has_around), _MAX_ADVANCES, clearance, ways, most, body]
        wp.launch(advance, dim=rows, inputs=inputs, outputs=[at.pose], device=d)

    def max_penetration(self, at: Hands) -> np.ndarray:
        """Depth of the deepest point of hands in anything, or of that in them [m], negative apart, (N,)."""
        rows = at.pose.shape[0]
        m, body = self._matches(rows), self._body(rows)
        self._place(at, body)
        self._match_object(m, body, self.params.reach)
        out = wp.empty(rows, dtype=wp.float32, device=self.device)
        inputs = [m, self._points, self._solids, body]
        wp.launch(penetration, dim=rows, inputs=inputs, outputs=[out], device=self.device)
        return to_numpy(out)

    def _settings(self, surface: HandSurface) -> "Search":
        p, tree, t = self.params, self._hand.model.tree, self._target
        total, span = float(surface.weight.sum()), np.maximum(tree.joint_upper - tree.joint_lower, 1e-6)
        ends = {"lower": tree.joint_lower, "upper": tree.joint_upper, "near": LIMIT_SHARE * span}
        return make_struct(
            Search,
            p,
            t,
            points=p.points / total,
            normals=p.normals / total,
            force=p.force / p.contacts**2,
            limits=p.limits / len(tree.joint_lower),
            sgd=int(p.optimizer == "sgd"),
            middle=wp.vec3(*map(float, _middle(self._hand, surface))),
            column=wp.array(tree.joint_column, dtype=wp.int32, device=self.device),
            **{name: wp.array(x, dtype=wp.float32, device=self.device) for name, x in ends.items()},
        )

    def _matches(self, rows: int) -> "Correspondences":
        links, pairs = self._solids.body.shape[0], self._solids.pairs.shape[0]
        wide = {
            "contacts": (self.params.contacts, wp.int32),
            "deep": (links * DEEPEST, wp.vec3),
            "deep_plane": (links * DEEPEST, wp.vec4),
            "link_pair": (pairs, wp.int32),
            "link_deep": (pairs * LINK_DEEPEST, wp.vec3),
            "link_plane": (pairs * LINK_DEEPEST, wp.vec4),
        }
        given = {name: wp.empty((rows, n), dtype=kind, device=self.device) for name, (n, kind) in wide.items()}
        plane = wp.empty((rows, self._points.points.shape[0]), dtype=wp.vec4, device=self.device)
        block = wp.empty_like(plane) if self._target.has_around else plane
        return empty_struct(Correspondences, self.device, *plane.shape, plane=plane, block=block, **given)

    def _moments(self, rows: int) -> "Moments":
        shape = (rows, 6 + self._hand.model.dofs)
        first, second = (wp.zeros(shape, dtype=wp.float32, device=self.device) for _ in range(2))
        return make_struct(Moments, first=first, second=second)

    def _body(self, rows: int) -> wp.array:
        return wp.empty((rows, self._bodies), dtype=wp.transform, device=self.device)

    def _place(self, at: Hands, body: wp.array) -> None:
        inputs = [self._hand.struct.kin, at.pose, at.q]
        wp.launch(place_bodies, dim=at.pose.shape[0], inputs=inputs, outputs=[body], device=self.device)

    def _match(self, at: Hands, m: "Correspondences", body: wp.array, reach: float) -> None:
        p, d, rows = self.params, self.device, at.pose.shape[0]
        points, solids = self._points, self._solids
        self._place(at, body)
        self._match_object(m, body, reach)
        near = max(p.contacts, int(p.nearest * points.palmar.shape[0]))
        lanes = lanes_of(d)
        inputs = [points, near, p.contacts, lanes, body, m]
        wp.launch(choose_contacts, dim=(rows, lanes), inputs=inputs, device=d, block_dim=LANES)
        wp.launch(match_links, dim=(rows, lanes), inputs=[solids, p.margin, lanes, body, m], device=d, block_dim=LANES)

    def _match_object(self, m: "Correspondences", body: wp.array, reach: float) -> None:
        p, t, d, rows = self.params, self._target, self.device, body.shape[0]
        points, solids = self._points, self._solids
        every = make_struct(Surroundings, t, has_around=int(t.has_around))
        dim, lanes = rows * points.body.shape[0], lanes_of(d)
        inputs = [points, every, p.touching, reach, p.soft, lanes, body, m]
        wp.launch(match_points, dim=(dim, lanes), inputs=inputs, device=d, block_dim=LANES)
        inputs = [solids, t.cloud, p.margin, body, m]
        wp.launch(match_solids, dim=(solids.body.shape[0], rows), inputs=inputs, device=d)

    def _descend(
        self, at: Hands, m: "Correspondences", taken: int, first: int, whole: int, gradient: bool, moments: "Moments"
    ) -> None:
        parts = make_struct(Parts, points=self._points, solids=self._solids, own=self._target.own)
        skipped = first * self.params.gradient_steps
        schedule = make_struct(Schedule, taken=taken, skipped=skipped, whole=float(whole), gradient=int(gradient))
        scratch = self._scratch(at.pose.shape[0])
        inputs = [self._hand.struct.kin, parts, self._search, m, schedule, scratch, moments]
        dim = (scratch.X.shape[0], scratch.lanes)
        wp.launch(descend, dim=dim, inputs=inputs, outputs=[at.pose, at.q], device=self.device, block_dim=LANES)

    def _scratch(self, rows: int) -> "DescentScratches":
        """For as many hands as are moved at a time."""
        most = _WORKERS if lanes_of(self.device) > 1 else 1
        parts = self._points.body.shape[0] + self.params.contacts + self._solids.body.shape[0]
        wide: dict[str, Any] = dict.fromkeys(("X", "F", "M"), self._bodies) | {"by_joint": self._bodies, "moved": 6}
        wide |= dict.fromkeys(("part_body", "part_force", "part_moment"), parts) | {"by_q": self._hand.model.dofs}
        return empty_rows(DescentScratches, min(rows, most), wide, self.device)


def _middle(hand: HandArrays, surface: HandSurface) -> np.ndarray:
    """Middle of the palmar points of the open hand, base frame [m], (3,)."""
    T = device_matrix(body_poses(hand, hand.model.tree.joint_open[None])[0])[surface.body]
    x = np.einsum("lij,lpj->lpi", T[:, :3, :3], surface.points) + T[:, None, :3, 3]
    return x[surface.weight > 0].mean(0)


def _points(surface: HandSurface, device: str) -> "Points":
    weight = surface.weight.ravel()
    arrays = {
        "block": BLOCK,
        "body": surface.body,
        "points": surface.points.reshape(-1, 3),
        "normals": surface.normals.reshape(-1, 3),
        "weight": weight,
        "palmar": np.flatnonzero(weight > 0),
    }
    return upload_struct(Points, device, arrays)


def _solids(found: HandPoints, device: str) -> "Solids":
    own = [x.grid for x in found.solids]
    grids = {
        "first": np.cumsum([0, *[g.values.size for g in own[:-1]]]),
        "shape": np.array([g.values.shape for g in own]),
        "origin": np.array([g.origin for g in own]),
        "inv_cell": 1.0 / np.array([g.cell for g in own]),
        "values": np.concatenate([g.values.ravel() for g in own]),
    }
    arrays = {
        "body": found.body,
        "ball": np.stack([x.ball for x in found.solids]),
        "grids": upload_struct(Grids, device, grids),
        "points": np.stack([link_probes(x.points) for x in found.solids]),
        "pairs": np.concatenate([found.pairs, found.pairs[:, ::-1]]).reshape(-1, 2),
    }
    return upload_struct(Solids, device, arrays)


def _resolve_penetration(search: Descent, tree: Tree, back: np.ndarray, at: Hands, most: float) -> None:
    """Move deep hands out, in place: straight along the shortest of some ways, or else opened and back.

    Args:
        back: direction away from what the palm faces, base frame, (3,).
        most: how far straight at most [m].
    """
    least = search.max_penetration(at)
    left = np.flatnonzero(least > _DEEP_PENETRATION)
    if len(left) == 0:
        return
    pose, q = (x.copy() for x in at.arrays())
    given, joints = pose.copy(), q.copy()

    def attempt(shifts: np.ndarray, opened: np.ndarray) -> None:
        """Hands that are left take the best of some changes: shifts (n, W, 3) [m], shares opened (W,)."""
        nonlocal left
        ways = len(opened)
        tried, bent = (x[left][:, None].repeat(ways, 1) for x in (given, joints))
        tried[..., :3] += shifts
        bent += opened[:, None] * (tree.joint_open - bent)
        depth = search.max_penetration(Hands.put(tried.reshape(-1, 7), bent.reshape(-1, q.shape[1]), search.device))
        depth = depth.reshape(-1, ways)
        free = depth < _FREE_PENETRATION
        best = np.where(free.any(1), free.argmax(1), depth.argmin(1))
        found = depth[np.arange(len(left)), best]
        better = found < least[left]
        rows = left[better]
        pose[rows], q[rows], least[rows] = tried[better, best[better]], bent[better, best[better]], found[better]
        left = left[least[left] > _FREE_PENETRATION]

    for number in range(1, int(most / _STRAIGHT_STEP + 1e-9) + 1):
        if len(left):
            attempt(number * _STRAIGHT_STEP * _DIRECTIONS[None], np.zeros(len(_DIRECTIONS)))
    for number in range(int(_BACK_FACTOR * most / _BACK_STEP + 1e-9) + 1):
        if len(left):
            away = device_rotation(given[left]).apply(back)
            attempt(number * _BACK_STEP * away[:, None].repeat(len(_OPENING_SHARES), 1), _OPENING_SHARES)
    at.pose.assign(pose)
    at.q.assign(q)
