"""The one check of a finished grasp: every claim computed on the final joints, control poses, and rows that pass.

Stage filter hands over hands whose contacts it knows, on a device; everybody else goes by :func:`check_grasps`.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from lgrasp.grasp.approach_kernels import (
    GPU_STRETCHES,
    RETREATS,
    Palm,
    check_table,
    check_way,
    choose_approach,
    close_above,
    try_retreats,
)
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.check_kernels import (
    ALL,
    check_postures,
    count_outcomes,
    list_kept,
    measure_held_penetration,
    measure_penetration,
    pack_rows,
)
from lgrasp.grasp.check_structs import CheckedPostures, Findings, Limits, Packed, Places, device_limits, new_findings
from lgrasp.grasp.closing_kernels import CLOSING_PLACES, find_crossings, keep_closed, measure_closing
from lgrasp.grasp.collision import depth_slices
from lgrasp.grasp.control_kernels import control_poses, drop_limp, limit_squeeze, press_shared
from lgrasp.grasp.held import HeldArrays, hold_nothing
from lgrasp.grasp.outcomes import LATE, MEASURED, METRICS, REASONS, SHARED, Outcome, bounds_squeeze, failed_squeeze
from lgrasp.grasp.pregrasp_kernels import (
    FINGER_TRIES,
    OPENING_SHARES,
    check_openings,
    find_distances_off,
    open_fingers,
    open_poses,
    try_fingers,
    try_openings,
)
from lgrasp.grasp.quality_kernels import balance_grasps, center_forces, drop_light, grasp_epsilon, resist_loads
from lgrasp.grasp.schema import POSTURES
from lgrasp.grasp.stability_kernels import find_stable_squeeze
from lgrasp.grasp.tables import GraspTable, take_rows
from lgrasp.hand.arrays import HandArrays
from lgrasp.hand.contact_surface import palm_axis
from lgrasp.hand.model import HandModel
from lgrasp.math.constants import LOAD_DIRECTIONS
from lgrasp.math.kinematics import vec_dof
from lgrasp.object.arrays import ObjectArrays
from lgrasp.runtime.fetch import fetch, to_numpy
from lgrasp.runtime.scan import running_sums
from lgrasp.runtime.structs import empty_struct, make_struct, on_device
from lgrasp.runtime.tally import Tally, empty_tally, read_tallies

_MAX_RANKED_PENETRATION = 0.03  # [m] penetrations above this are not distinguished
_ON_TABLE = {"resting": "pose", "approach": "approach"}  # columns of rows on a table, and their names in it


@dataclass(frozen=True)
class Check:
    """Hands of one kind before one object, on a device, and what is known of them so far."""

    hand: HandArrays
    obj: ObjectArrays
    held: HeldArrays
    limits: Limits
    places: Places
    at: CheckedPostures
    found: Findings

    def __len__(self) -> int:
        return self.at.of.shape[0]

    @property
    def bodies(self) -> int:
        """Bodies of the hand, the base included."""
        return len(self.hand.model.piece_first) - 1

    def measure(self, part: int, obj: ObjectArrays | None = None) -> None:
        """Measure the penetration of a part of the hands and the object, or another one."""
        d, slices = self.hand.device, depth_slices(self.hand.device)
        inputs = [self.hand.struct, (obj or self.obj).struct, self.limits, part, slices, self.at]
        wp.launch(measure_penetration, (slices, self.bodies, len(self)), inputs, [self.found], device=d)

    def measure_held(self) -> None:
        """The same of the hands, the object and what is held already."""
        inputs = [self.hand.struct, self.obj.struct, self.held.struct, self.limits, self.at]
        wp.launch(measure_held_penetration, (self.bodies, len(self)), inputs, [self.found], device=self.hand.device)

    def clear_table(self, part: int) -> None:
        """Refuse hands of which a part is not above the table of the object, if there is one."""
        if self.obj.planes is not None:
            inputs = [self.hand.struct, self.obj.struct, self.limits, part, self.at]
            wp.launch(check_table, (self.bodies, len(self)), inputs, [self.found], device=self.hand.device)

    def decide(self) -> tuple[Tally, wp.array]:
        """The remaining checks, of the contacts' forces: hands by outcome, and for each hand whether it passed."""
        d, n = self.hand.device, len(self)
        wp.launch(balance_grasps, n, [self.limits, self.places, self.at], [self.found], device=d)
        inputs = [self.obj.struct, self.limits, self.places, self.at]
        wp.launch(resist_loads, (LOAD_DIRECTIONS, n), inputs, [self.found], device=d)
        reasons = REASONS if self.obj.touch is None else SHARED
        tally, passed = empty_tally(reasons, d), wp.empty(n, dtype=wp.int32, device=d)
        wp.launch(count_outcomes, n, [self.limits], [self.found, passed, tally.device], device=d)
        return tally, passed

    def kept(self, seed: wp.array) -> tuple[GraspTable, Tally]:
        """The hands that pass, as rows, after one wait for the device; and the number of hands by outcome.

        Args:
            seed: of the random rays of epsilon, (1,) i32.
        """
        tally, upto = self.decide()
        running_sums(upto)
        row = wp.full(len(self), -1, dtype=wp.int32, device=self.hand.device)
        wp.launch(list_kept, len(self), [self.found, upto], [row], device=self.hand.device)
        packed, on_table = self._pack(seed, row), self.obj.planes is not None
        self._share(row, tally)
        bounded = bounds_squeeze(self.limits)
        if bounded:
            wp.launch(drop_limp, len(self), [self.limits, packed], [row, tally.device], device=self.hand.device)
        if on_table:
            self._approach(row, packed, tally)
        columns, dropped = _columns(packed, on_table), bounded or self.obj.touch is not None
        fetched = read_tallies([tally], [*columns.values(), *([row] if dropped else [])], others=True)
        count = sum(tally[reason] for reason in tally.names if reason in LATE)
        table = _table(dict(zip(columns, fetched, strict=False)), count)
        kept = fetched[-1][:count] >= 0 if dropped else np.ones(count, bool)
        if on_table:
            kept &= ~np.isnan(table.table["approach"][:, 0])
        return table if kept.all() else take_rows(table, kept), tally

    def every(self, seed: wp.array, *, on_table: bool = False) -> tuple[GraspTable, np.ndarray]:
        """All hands as rows in their order, and their outcomes (:class:`~lgrasp.grasp.outcomes.Outcome`), (n,).

        Args:
            on_table: each object rests on one of its planes; NaN as ``approach`` where the hand has no way there.
        """
        tally, _ = self.decide()
        row = wp.array(np.arange(len(self)), dtype=wp.int32, device=self.hand.device)
        packed = self._pack(seed, row)
        if on_table:
            self._approach(row, packed, tally)
        columns = _columns(packed, on_table)
        *fetched, outcome = fetch([*columns.values(), self.found.outcome])
        table = _table(dict(zip(columns, fetched, strict=True)), len(self))
        limp = np.any(failed_squeeze(table, self.limits), axis=0)
        outcome = np.where(limp & (outcome == Outcome.KEPT), Outcome.SQUEEZE, outcome)
        if on_table:
            lost = np.isnan(table.table["approach"][:, 0]) & (outcome == Outcome.KEPT)
            outcome = np.where(lost, Outcome.APPROACH, outcome)
        return table, outcome

    def _share(self, row: wp.array, tally: Tally) -> None:
        """Of the hands ``row`` those are dropped whose forces are not on the region to touch, as far as they must."""
        if self.obj.touch is not None and self.obj.steered:
            least = self.obj.steered.weights.share
            inputs = [self.places, self.obj.touch, least, self.at, self.found]
            wp.launch(drop_light, len(self), inputs, [row, tally.device], device=self.hand.device)

    def _approach(self, row: wp.array, packed: Packed, tally: Tally) -> None:
        """A straight way for the open hand to the hands ``row``; those without one are counted as such."""
        d, m = self.hand.device, len(self)
        centre, facing = palm_axis(self.hand.model)
        palm = make_struct(Palm, centre=wp.vec3(*map(float, centre)), facing=wp.vec3(*map(float, facing)))
        packed.resting, packed.approach = wp.empty(m, dtype=wp.int32, device=d), wp.empty(m, dtype=wp.vec3, device=d)
        clear, refused = (wp.zeros(m, dtype=wp.int32, device=d) for _ in range(2))
        inputs = [self.hand.struct, self.obj.struct, self.limits, palm, self.at, row, packed]
        wp.launch(try_retreats, (m, RETREATS), inputs, [clear], device=d)
        stretches = 1 if d == "cpu" else GPU_STRETCHES
        wp.launch(check_way, (stretches, self.bodies, m), [*inputs, clear, stretches], [refused], device=d)
        inputs = [self.hand.struct, self.obj.struct, self.limits, self.at, row, packed]
        wp.launch(close_above, (self.hand.model.groups, m), inputs, [refused], device=d)
        inputs = [self.obj.struct, palm, self.at, row, clear, refused]
        wp.launch(choose_approach, m, inputs, [packed, tally.device], device=d)

    def _pack(self, seed: wp.array, row: wp.array) -> Packed:
        """What is stored of the hands ``row`` (-1: none), arrays as long as there are hands."""
        d, m, model = self.hand.device, len(self), self.hand.model
        hand, obj, limits, places = self.hand.struct, self.obj.struct, self.limits, self.places
        at, found = self.at, self.found
        postures = {n: wp.empty((m, model.dofs), dtype=wp.float32, device=d) for n in POSTURES}
        numbers = wp.empty((len(MEASURED), m), dtype=wp.float32, device=d)
        grown = {n: wp.zeros(m, dtype=wp.float32, device=d) for n in ("closing_penetration", "closing_sweep")}
        none = {"resting": wp.empty(0, dtype=wp.int32, device=d), "approach": wp.empty(0, dtype=wp.vec3, device=d)}
        packed = empty_struct(Packed, d, m, at.contact.shape[1], numbers=numbers, **postures, **grown, **none)
        opened = wp.empty((m, model.groups, 2), dtype=vec_dof, device=d)
        wp.launch(center_forces, m, [limits, places, at, row], [found], device=d)
        inputs = [hand, limits, places, at, found, row]
        wp.launch(control_poses, (m, model.groups), inputs, [packed, opened], device=d)
        if model.tree.shared_names:
            wp.launch(press_shared, m, inputs, [packed], device=d)
        wp.launch(find_stable_squeeze, m, inputs, [packed], device=d)
        wp.launch(limit_squeeze, m, [hand, limits, row], [packed], device=d)
        tried, stuck = wp.zeros(m, dtype=wp.int32, device=d), wp.zeros(1 + m, dtype=wp.int32, device=d)
        off = wp.empty((m, self.bodies - 1), dtype=wp.float32, device=d)
        wp.launch(find_distances_off, (self.bodies - 1, m), [hand, obj, limits, places, at, row], [off], device=d)
        inputs = [hand, obj, self.held.struct, limits, at, opened, row, off]
        wp.launch(try_openings, (OPENING_SHARES, m), inputs, [tried], device=d)
        again = [hand, obj, self.held.struct, at, opened, row, off]
        wp.launch(check_openings, (self.bodies - 1, m), again, [tried], device=d)
        wp.launch(open_poses, m, [hand, at, opened, row, tried], [packed, stuck], device=d)
        clear = wp.zeros((m, model.groups), dtype=wp.int32, device=d)
        wp.launch(try_fingers, (m, model.groups, FINGER_TRIES), [*inputs, stuck], [clear], device=d)
        inputs = [hand, self.held.struct, limits, at, opened, row, stuck, clear]
        wp.launch(open_fingers, m, inputs, [packed], device=d)
        crossed = wp.zeros(m, dtype=wp.int32, device=d)
        wp.launch(find_crossings, (CLOSING_PLACES, m), [hand, at, row, packed], [crossed], device=d)
        wp.launch(keep_closed, m, [hand, at, row, crossed], [packed], device=d)
        wp.launch(measure_closing, (model.groups, m), [hand, obj, at, row, off], [packed], device=d)
        wp.launch(grasp_epsilon, m, [obj, seed, limits, places, at, row], [packed], device=d)
        wp.launch(pack_rows, m, [hand, places, at, found, row], [packed], device=d)
        return packed


def _columns(packed: Packed, on_table: bool) -> dict[str, wp.array]:
    """The arrays of rows, on a table or not."""
    return {name: getattr(packed, name) for name in Packed.vars if on_table or name not in _ON_TABLE}


def _table(columns: dict[str, np.ndarray], count: int) -> GraspTable:
    """The first ``count`` rows of what :func:`_columns` gave."""
    x: dict[str, Any] = {name: values[:count] for name, values in columns.items() if name != "numbers"}
    numbers = dict(zip(MEASURED, columns["numbers"][:, :count], strict=True))
    numbers |= {name: x.pop(name) for name in METRICS if name in x}
    numbers["force_closure"] = (numbers["epsilon"] > 0).astype(np.float32)
    numbers["normal_error"] = np.arccos(np.clip(numbers["facing"], -1, 1))
    x["index"] = x["index"].astype(np.int64)
    x["table"] = {name: x.pop(column) for column, name in _ON_TABLE.items() if column in x}
    return GraspTable(**x, metrics={name: numbers[name] for name in METRICS})


class ContactTable(NamedTuple):
    """Contacts of n hands, C at most each, on a device."""

    link: wp.array
    """Index in ``link_names``, -1 for none, (n, C) i32."""
    points: wp.array
    """On the object, its internal frame [m], (n * C,) vec3."""
    normals: wp.array
    """Outward, (n * C,) vec3."""


def known_contacts(links: np.ndarray, points: np.ndarray, normals: np.ndarray, device: str) -> ContactTable:
    """Contacts as a table has them: links (n, C), -1 for none, points and outward normals (n, C, 3)."""
    flat = (np.nan_to_num(a).reshape(-1, 3) for a in (points, normals))
    own = wp.array(links, dtype=wp.int32, device=device)
    return ContactTable(own, *(wp.array(a, dtype=wp.vec3, device=device) for a in flat))


def check_grasps(
    hand: HandArrays,
    obj: ObjectArrays,
    pose: np.ndarray | wp.array,
    q: np.ndarray | wp.array,
    contacts: ContactTable,
    bounds: GraspBounds,
    *,
    around: ObjectArrays | None = None,
    resting: np.ndarray | None = None,
    index: np.ndarray | None = None,
    seed: wp.array | None = None,
) -> tuple[GraspTable, np.ndarray]:
    """All hands as rows in the order given, measured to the end, and their outcomes, (n,).

    Args:
        pose: T_hand_object of the object's internal frame, x y z [m] qx qy qz qw, (n, 7).
        q: joint positions within their limits [rad or m], (n, K).
        contacts: what touches (:func:`known_contacts`, :func:`~lgrasp.grasp.find_contacts.find_contacts`).
        around: what else the hand must not penetrate, at q_pregrasp neither, in the object's internal frame.
        resting: plane of ``obj`` that is each row's table, which the hand and its way there must clear, (n,) int.
        index: candidate of each row; default: the row.
        seed: of the random rays of epsilon; default: 0.
    """
    check = _measured(hand, obj, pose, q, contacts, bounds, around, resting)
    seed = wp.zeros(1, dtype=wp.int32, device=hand.device) if seed is None else seed
    table, outcome = check.every(seed, on_table=resting is not None)
    if around is not None:
        opened = _measured(hand, around, pose, table.q_pregrasp, contacts, bounds, None, None)
        deep = fetch([opened.found.penetration])[0] > bounds.max_penetration
        outcome = np.where(deep & (outcome == Outcome.KEPT), Outcome.OBJECT_COLLISION, outcome)
    table.index[:] = np.arange(len(check)) if index is None else index
    return table, outcome


class Compared(NamedTuple):
    """What n hands are ranked by, (n,) each."""

    outcome: np.ndarray
    """But for what control poses show."""
    unresisted_load: np.ndarray
    penetration: np.ndarray
    """[m]"""


def compare_grasps(
    hand: HandArrays,
    obj: ObjectArrays,
    pose: np.ndarray | wp.array,
    q: np.ndarray | wp.array,
    contacts: ContactTable,
    bounds: GraspBounds,
    *,
    around: ObjectArrays | None = None,
) -> Compared:
    """A part of what :func:`check_grasps` finds, sooner; ``Args`` as there."""
    check = _measured(hand, obj, pose, q, contacts, bounds, around, None)
    check.decide()
    return Compared(*fetch([getattr(check.found, name) for name in Compared._fields]))


def _measured(
    hand: HandArrays,
    obj: ObjectArrays,
    pose: np.ndarray | wp.array,
    q: np.ndarray | wp.array,
    contacts: ContactTable,
    bounds: GraspBounds,
    around: ObjectArrays | None,
    resting: np.ndarray | None,
) -> Check:
    """Hands of which all is measured but the forces; see :func:`check_grasps`."""
    d, (n, width), model = hand.device, contacts.link.shape, hand.model
    zeros = wp.zeros(n, dtype=wp.int32, device=d)
    surface = np.where(to_numpy(contacts.link) >= 0, np.arange(n * width).reshape(n, width), -1)
    at = empty_struct(
        CheckedPostures,
        d,
        *(n, model.groups),
        pose=on_device(pose, wp.transform, d),
        of=wp.array(np.arange(n), dtype=wp.int32, device=d),
        index=zeros,
        resting=wp.array(np.full(n, -1) if resting is None else resting, dtype=wp.int32, device=d),
        slot=zeros,
        body=wp.empty((n, len(model.piece_first) - 2), dtype=wp.transform, device=d),
        contact=contacts.link,
        surface=wp.array(surface, dtype=wp.int32, device=d),
    )
    limits = device_limits(bounds, deepest=_MAX_RANKED_PENETRATION)
    places, found = _link_places(model, contacts, d), new_findings(n, width, d)
    check = Check(hand, obj, hold_nothing(hand), limits, places, at, found)
    inputs = [hand.struct, check.held.struct, limits, places, on_device(q, wp.float32, d)]
    wp.launch(check_postures, n, inputs, [at, found], device=d)
    for solid in (obj, around):
        if solid is not None:
            check.measure(ALL, solid)
    if resting is not None:
        check.clear_table(ALL)
    return check


def _link_places(model: HandModel, contacts: ContactTable, device: str) -> Places:
    """Every link as a place on the hand, and the contacts as places on the object."""
    links = len(model.tree.link_names)
    grid = np.full(links, -1)
    grid[model.grid_link] = np.arange(len(model.grid_link))
    on_hand = {"link": np.arange(links), "body": model.tree.link_body, "grid": grid}
    put = {name: wp.array(values, dtype=wp.int32, device=device) for name, values in on_hand.items()}
    return make_struct(Places, points=contacts.points, normals=contacts.normals, **put)
