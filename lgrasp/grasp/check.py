"""The one check of a finished grasp: every claim computed on the final joints, control poses, and rows that pass.

Stage filter hands over hands whose contacts it knows, on a device; everybody else goes by :func:`check_grasps`.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import warp as wp

from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.check_kernels import (
    ALL,
    check_postures,
    count_outcomes,
    list_kept,
    measure_held_penetration,
    measure_penetration,
    pack_rows,
    self_overlap,
)
from lgrasp.grasp.check_structs import CheckedPostures, Findings, Limits, Packed, Places, device_limits, new_findings
from lgrasp.grasp.control_kernels import control_poses, open_poses
from lgrasp.grasp.held import HeldArrays, hold_nothing
from lgrasp.grasp.outcomes import MEASURED, METRICS, REASONS
from lgrasp.grasp.quality_kernels import balance_grasps, center_forces, grasp_epsilon, resist_loads
from lgrasp.grasp.tables import GraspTable
from lgrasp.hand.arrays import HandArrays
from lgrasp.hand.model import HandModel
from lgrasp.math.kinematics import vec_dof
from lgrasp.object.arrays import ObjectArrays
from lgrasp.runtime.scan import running_sums
from lgrasp.runtime.tally import Tally, empty_tally, read_tallies

_MAX_RANKED_PENETRATION = 0.03  # [m] penetrations above this are not distinguished
_LOAD_DIRECTIONS = 6


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
        inputs = [self.hand.struct, (obj or self.obj).struct, self.limits, part, self.at]
        wp.launch(measure_penetration, (self.bodies, len(self)), inputs, [self.found], device=self.hand.device)

    def measure_held(self) -> None:
        """The same of the hands, the object and what is held already."""
        inputs = [self.hand.struct, self.obj.struct, self.held.struct, self.limits, self.at]
        wp.launch(measure_held_penetration, (self.bodies, len(self)), inputs, [self.found], device=self.hand.device)

    def decide(self) -> tuple[Tally, wp.array]:
        """The remaining checks, of the contacts' forces: hands by outcome, and for each hand whether it passed."""
        d, n = self.hand.device, len(self)
        wp.launch(balance_grasps, n, [self.limits, self.places, self.at], [self.found], device=d)
        inputs = [self.obj.struct, self.limits, self.places, self.at]
        wp.launch(resist_loads, (_LOAD_DIRECTIONS, n), inputs, [self.found], device=d)
        tally, passed = empty_tally(REASONS, d), wp.empty(n, dtype=wp.int32, device=d)
        wp.launch(count_outcomes, n, [self.limits], [self.found, passed, tally.device], device=d)
        return tally, passed

    def kept(self, seed: wp.array) -> tuple[GraspTable, Tally]:
        """The hands that pass, as rows, after one wait for the device; and the number of hands by outcome.

        Args:
            seed: of the random rays of epsilon, (1,) i32.
        """
        tally, upto = self.decide()
        running_sums(upto)
        row = wp.empty(len(self), dtype=wp.int32, device=self.hand.device)
        wp.launch(list_kept, len(self), [self.found, upto], [row], device=self.hand.device)
        columns = self._columns(seed, tally.device[:1], row)
        fetched = read_tallies([tally], list(columns.values()))
        count = tally["kept"]
        return _table(dict(zip(columns, fetched, strict=True)), count), tally

    def every(self, seed: wp.array) -> tuple[GraspTable, np.ndarray]:
        """All hands as rows in their order, and their outcomes (:class:`~lgrasp.grasp.outcomes.Outcome`), (n,)."""
        d, n = self.hand.device, len(self)
        self.decide()
        row = wp.array(np.arange(n, dtype=np.int32), dtype=wp.int32, device=d)
        columns = self._columns(seed, wp.full(1, n, dtype=wp.int32, device=d), row)
        return _table({name: values.numpy() for name, values in columns.items()}, n), self.found.outcome.numpy()

    def _columns(self, seed: wp.array, rows: wp.array, row: wp.array) -> dict[str, wp.array]:
        """What is stored of the first ``rows[0]`` of the hands ``row``, arrays as long as there are hands."""
        d, m, model = self.hand.device, len(self), self.hand.model
        width, hand, obj = self.at.contact.shape[1], self.hand.struct, self.obj.struct
        limits, places, at, found = self.limits, self.places, self.at, self.found
        q, pregrasp, squeeze = (wp.empty((m, model.dofs), dtype=wp.float32, device=d) for _ in range(3))
        opened = wp.empty((m, model.groups), dtype=vec_dof, device=d)
        epsilon, overlap = (wp.empty(m, dtype=wp.float32, device=d) for _ in range(2))
        wp.launch(center_forces, m, [limits, places, at, rows, row], [found], device=d)
        inputs = [hand, limits, places, at, found, rows, row]
        wp.launch(control_poses, (m, model.groups), inputs, [q, squeeze, opened], device=d)
        inputs = [hand, obj, self.held.struct, limits, at, opened, rows, row]
        wp.launch(open_poses, m, inputs, [pregrasp], device=d)
        wp.launch(grasp_epsilon, m, [obj, seed, limits, places, at, rows, row], [epsilon], device=d)
        wp.launch(self_overlap, m, [hand, at.body, rows, row], [overlap], device=d)
        p = Packed()
        p.pose = wp.empty(m, dtype=wp.transform, device=d)
        p.point, p.normal, p.force = (wp.empty((m, width), dtype=wp.vec3, device=d) for _ in range(3))
        p.link = wp.empty((m, width), dtype=wp.int32, device=d)
        p.index, p.slot = (wp.empty(m, dtype=wp.int32, device=d) for _ in range(2))
        p.numbers = wp.empty((len(MEASURED), m), dtype=wp.float32, device=d)
        wp.launch(pack_rows, m, [places, at, found, rows, row], [p], device=d)
        own = {"q": q, "q_pregrasp": pregrasp, "q_squeeze": squeeze, "epsilon": epsilon, "self_penetration": overlap}
        return own | {name: getattr(p, name) for name in Packed.vars}


def _table(columns: dict[str, np.ndarray], count: int) -> GraspTable:
    """The first ``count`` rows of what :meth:`Check._columns` gave."""
    numbers = dict(zip(MEASURED, columns["numbers"][:, :count], strict=True))
    x = {name: values[:count] for name, values in columns.items() if name != "numbers"}
    numbers |= {"epsilon": x["epsilon"], "self_penetration": x["self_penetration"]}
    numbers["normal_error"] = np.arccos(np.clip(numbers["facing"], -1, 1))
    return GraspTable(
        index=x["index"].astype(np.int64),
        slot=x["slot"],
        q=x["q"],
        q_pregrasp=x["q_pregrasp"],
        q_squeeze=x["q_squeeze"],
        pose=x["pose"].reshape(-1, 7),
        contact_points=x["point"],
        contact_normals=x["normal"],
        contact_links=x["link"],
        contact_forces=x["force"],
        metrics={name: numbers[name] for name in METRICS},
    )


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
    flat = (np.nan_to_num(np.ascontiguousarray(a, np.float32)).reshape(-1, 3) for a in (points, normals))
    own = wp.array(np.ascontiguousarray(links, np.int32), dtype=wp.int32, device=device)
    return ContactTable(own, *(wp.array(a, dtype=wp.vec3, device=device) for a in flat))


def check_grasps(
    hand: HandArrays,
    obj: ObjectArrays,
    pose: np.ndarray,
    q: np.ndarray,
    contacts: ContactTable,
    bounds: GraspBounds,
    *,
    around: ObjectArrays | None = None,
    index: np.ndarray | None = None,
    seed: wp.array | None = None,
) -> tuple[GraspTable, np.ndarray]:
    """All hands as rows in the order given, measured to the end, and their outcomes, (n,).

    Args:
        pose: T_hand_object of the object's internal frame, x y z [m] qx qy qz qw, (n, 7).
        q: joint positions within their limits [rad or m], (n, K).
        contacts: what touches (:func:`known_contacts`, :func:`~lgrasp.grasp.find_contacts.find_contacts`).
        around: what else the hand must not penetrate, in the object's internal frame.
        index: candidate of each row; default: the row.
        seed: of the random rays of epsilon; default: 0.
    """
    d, n, width = hand.device, len(q), contacts.link.shape[1]
    groups, bodies = hand.model.groups, len(hand.model.piece_first) - 1
    rows = wp.array(np.arange(n, dtype=np.int32), dtype=wp.int32, device=d)
    at = CheckedPostures()
    at.pose = wp.array(np.ascontiguousarray(pose, np.float32), dtype=wp.transform, device=d)
    at.of, at.index, at.slot = rows, wp.zeros(n, dtype=wp.int32, device=d), wp.zeros(n, dtype=wp.int32, device=d)
    at.chosen = wp.empty((n, groups), dtype=wp.int32, device=d)
    at.body = wp.empty((n, bodies - 1), dtype=wp.transform, device=d)
    at.posture = wp.empty((n, groups), dtype=vec_dof, device=d)
    places = link_places(hand.model, contacts, d)
    at.contact = contacts.link
    surface = np.arange(n * width, dtype=np.int32).reshape(n, width)
    at.surface = wp.array(np.where(contacts.link.numpy() >= 0, surface, -1), dtype=wp.int32, device=d)
    found = new_findings(n, width, d)
    found.facing.fill_(1.0)
    check = Check(
        hand, obj, hold_nothing(hand), device_limits(bounds, deepest=_MAX_RANKED_PENETRATION), places, at, found
    )
    joints = wp.array(np.ascontiguousarray(q, np.float32), dtype=wp.float32, device=d)
    inputs = [hand.struct, check.held.struct, check.limits, places, joints]
    wp.launch(check_postures, n, inputs, [at, found], device=d)
    for solid in (obj, around):
        if solid is not None:
            check.measure(ALL, solid)
    table, outcome = check.every(wp.zeros(1, dtype=wp.int32, device=d) if seed is None else seed)
    if index is None:
        index = np.arange(n)
    table.index[:] = index
    return table, outcome


def link_places(model: HandModel, contacts: ContactTable, device: str) -> Places:
    """Every link as a place on the hand, and the contacts as places on the object."""
    links = len(model.tree.link_names)
    grid = np.full(links, -1)
    grid[model.grid_link] = np.arange(len(model.grid_link))

    def put(a: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(a, np.int32), dtype=wp.int32, device=device)

    places = Places()
    places.link, places.body, places.grid = put(np.arange(links)), put(model.tree.link_body), put(grid)
    places.points, places.normals = contacts.points, contacts.normals
    return places
