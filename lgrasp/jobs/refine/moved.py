"""Rows of one object moved by a local search, checked, and kept where they became better."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
import warp as wp

from lgrasp.errors import is_out_of_memory
from lgrasp.geometry.poses import internal_poses
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.check import known_contacts
from lgrasp.grasp.find_contacts import check_found
from lgrasp.grasp.outcomes import Outcome, failed_bounds
from lgrasp.grasp.records import GraspRows, padded
from lgrasp.grasp.rows import grasp_rows, press
from lgrasp.grasp.schema import POSTURES
from lgrasp.grasp.tables import CONTACTS, GraspTable, choose_grasps, join_rows, widen_grasps
from lgrasp.hand.arrays import HandArrays
from lgrasp.math.limits import MAX_CONTACTS
from lgrasp.object.arrays import ObjectArrays, upload_object
from lgrasp.object.model import ObjectModel, SteeredObject
from lgrasp.refine.energy import Energies
from lgrasp.refine.improve import improve
from lgrasp.refine.refiner import Refiner, table_pose
from lgrasp.stages.refine.params import RefineParams
from lgrasp.steer.demands import Demands

_BATCH_ROWS = 256  # at a time
_GPU_BATCH_ROWS = 4096  # the most at a time on a GPU
_ROW_BYTES = 1 << 20  # that a row may need at a time; hands of five fingers need 0.6 MB
_MAX_OBJECT_DISTANCE = 0.5  # [m] from the object: nothing pulls there
_MIN_GAIN = 1e-3  # of a unit pull that must be resisted more to replace a valid row
_POSE_ROUNDING = 1e-6  # [m] of a pose in a file
_TOLD = {"valid", "failed_bound"}  # metrics that are of the last check
_JOINT_TOLERANCE = 1e-4  # [rad or m] that a joint may be outside its limits


class Moved(NamedTuple):
    """Outcomes of rows."""

    rows: GraspRows
    """Those to write in their order, with metrics ``energy`` and its terms at the posture stored, ``valid`` (passes
    every check) and ``refined`` (the posture is the refined one)."""
    energy: tuple[float, float]
    """Mean E* of all rows before and after the search."""
    valid: tuple[int, int]
    """Rows that pass every check, before and after."""
    failed: int
    """Rows that pass in neither posture."""
    clamped: int
    """Rows whose joints were outside their limits; they are moved, and kept where they stay, from within."""
    far: int
    """Rows whose hand is too far from the object to be drawn to it."""


def move_rows(
    hand: HandArrays,
    obj: ObjectModel | SteeredObject,
    rows: GraspRows,
    params: RefineParams,
    bounds: GraspBounds,
    *,
    asked: Demands | None,
    planes: np.ndarray | None,
    keep_invalid: bool,
    stored: bool,
    measured: bool,
    progress: Callable[[int], None] | None,
) -> Moved:
    """Refine rows of one object.

    A refined row takes the place of the one given where it passes every check, and that does not or resists loads less.
    Rows that pass in neither posture are left out.

    Args:
        obj: the object, or what is left of it for contacts.
        asked: what rows must obey.
        planes: those that the object rests on, (T, 5), where rows are of objects on a table: they must stay above it.
        keep_invalid: those rows are kept too, refined, with their own metrics, ``valid`` 0 and ``failed_bound``.
        stored: contacts of the rows are known, and rows that are not replaced stay as they are.
        measured: the rows, their control poses and metrics, are of these bounds.
    """
    arrays = upload_object(obj, hand.device, planes)
    model = arrays.model
    refiner = Refiner(hand.model, model, params, device=hand.device)
    outside = _outside(rows, hand)
    parts: list[_Part] = []
    first, size = 0, _batch_rows(hand.device)
    while first < len(rows):
        part = slice(first, first + size)
        try:
            parts.append(_moved_part(refiner, hand, arrays, rows, part, params, bounds, asked, stored))
        except RuntimeError as error:
            if size <= _BATCH_ROWS or not is_out_of_memory(error):
                raise
            size = max(size // 2, _BATCH_ROWS)  # others use the GPU, too
            continue
        first = part.stop
        if progress:
            progress(min(first, len(rows)))
    table = join_rows([p.table for p in parts])
    first_energy, last_energy = (np.concatenate(x, 1) for x in zip(*(p.energy for p in parts), strict=True))
    was, known, taken, good, failed = (np.concatenate([p.marks[k] for p in parts]) for k in range(5))
    terms = {f"energy_{name}": values for name, values in zip(Energies._fields, last_energy, strict=True)}
    valid = was | good
    extra = {"energy": last_energy.sum(0), **terms, "valid": valid, "refined": taken & _moved(rows, table, hand, model)}
    extra |= {"failed_bound": np.where(valid, 0, failed)} if keep_invalid else {}
    extra = {name: np.asarray(values, np.float32) for name, values in extra.items()}
    made = grasp_rows(press(table), hand.model.tree, model.center, extra=extra)
    made = replace(made, candidate=rows.candidate, table=_ways(rows.table, made.table))
    if stored:
        made = _kept(rows, made, taken | outside | ~known, measured)
    if not keep_invalid:
        made = made.select(valid)
    means = float(first_energy.sum(0).mean()), float(last_energy.sum(0).mean())
    far, lost = sum(p.far for p in parts), int((~valid).sum())
    return Moved(made, means, (int(was.sum()), int(valid.sum())), lost, int(outside.sum()), far)


def _batch_rows(device: str) -> int:
    """How many rows are moved at a time: on a GPU more, in half of the memory that is free, as kernels need some."""
    if device == "cpu":
        return _BATCH_ROWS
    return int(np.clip(wp.get_device(device).free_memory / 2 // _ROW_BYTES, _BATCH_ROWS, _GPU_BATCH_ROWS))


class _Part(NamedTuple):
    table: GraspTable
    energy: tuple[np.ndarray, np.ndarray]  # terms before and after, (6, n)
    marks: tuple[np.ndarray, ...]  # valid before, with the contacts named, replaced, valid when refined, failed bound
    far: int


def _moved_part(
    refiner: Refiner,
    hand: HandArrays,
    obj: ObjectArrays,
    rows: GraspRows,
    part: slice,
    params: RefineParams,
    bounds: GraspBounds,
    asked: Demands | None,
    stored: bool,
) -> _Part:
    pose, q = _hands(rows, part, hand, obj.model)
    index = np.arange(len(rows))[part]
    resting = rows.table["pose"][part] if obj.planes is not None else None
    check = partial(check_found if asked is None else asked.check, hand, obj, bounds=bounds)
    old, outcome = check(pose, q, resting=resting, index=index)
    given = table_pose(old, hand.device)
    was = outcome == Outcome.KEPT
    known: np.ndarray = np.zeros(len(q), bool)
    if stored and np.shape(rows.contact_links)[2] <= MAX_CONTACTS:
        links, points, normals = (
            np.asarray(a)[part, 0] for a in (rows.contact_links, rows.contact_points, rows.contact_normals)
        )
        own = known_contacts(links, points - obj.model.center, normals, hand.device)
        told, outcome = check(pose, q, bounds=_rounded(bounds), contacts=own, resting=resting, index=index)
        known = outcome == Outcome.KEPT
        width = max(old.contact_links.shape[1], told.contact_links.shape[1])
        at = np.flatnonzero(known)
        old, was = choose_grasps(widen_grasps(old, width), widen_grasps(told, width), at, at), was | known
    tries = np.where(was | (params.matching_rounds == 0), 1, params.tries)
    new, outcome = improve(refiner.search, hand, check, pose, q, tries=tries, resting=resting, index=index)
    good = outcome == Outcome.KEPT
    lower = new.metrics["unresisted_load"] < old.metrics["unresisted_load"] - _MIN_GAIN
    taken = ~was | (good & lower)
    at = np.flatnonzero(taken)
    new = widen_grasps(new, old.contact_links.shape[1])
    table = choose_grasps(widen_grasps(old, new.contact_links.shape[1]), new, at, at)
    energies = [refiner.energy(*pose) for pose in (given, table_pose(table, hand.device))]
    before, after = (torch.stack(list(terms)).detach().cpu().numpy() for terms in energies)  # each (6, N)
    away = refiner.target.nearest(refiner.middle(given.R, given.t))[0]  # of the middle of the palmar side
    far = int((away > _MAX_OBJECT_DISTANCE).sum())
    failed = failed_bounds(new, outcome, bounds, hand.model.tree.link_groups)
    return _Part(table, (before, after), (was, known, taken, good, failed), far)


def _rounded(bounds: GraspBounds) -> GraspBounds:
    """The bounds for rows from a file, whose poses and contacts were rounded in it."""
    return bounds.model_copy(
        update={
            "max_gap": bounds.max_gap + _POSE_ROUNDING,
            "max_penetration": bounds.max_penetration + _POSE_ROUNDING,
            "min_self_distance": max(bounds.min_self_distance - _POSE_ROUNDING, 0.0),
            "min_table_distance": max(bounds.min_table_distance - _POSE_ROUNDING, 0.0),
            "max_normal_angle": bounds.max_normal_angle + np.degrees(10 * _POSE_ROUNDING),
            "max_gswo": bounds.max_gswo + 100 * _POSE_ROUNDING,
            "max_unresisted_load": bounds.max_unresisted_load + 1000 * _POSE_ROUNDING,
        }
    )


def _moved(rows: GraspRows, table: GraspTable, hand: HandArrays, obj: ObjectModel) -> np.ndarray:
    """Which hands (N,) are elsewhere in a table than in the rows that it was made of."""
    pose, q = _hands(rows, slice(None), hand, obj)
    far = np.maximum(np.abs(table.q - q).max(1), np.abs(table.pose - pose).max(1))
    return ~(far <= _POSE_ROUNDING)


def _ways(old: Mapping[str, np.ndarray], new: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns of rows on a table; hands without a way, which are invalid, keep the one that they had."""
    return {name: np.where(np.isnan(values), old[name], values).astype(old[name].dtype) for name, values in new.items()}


def _outside(rows: GraspRows, hand: HandArrays) -> np.ndarray:
    """Rows with joints outside their limits, (N,) bool."""
    limits, q = hand.model.tree.listed_limits, np.asarray(rows.q)
    return np.asarray(((q < limits[:, 0] - _JOINT_TOLERANCE) | (q > limits[:, 1] + _JOINT_TOLERANCE)).any(1))


def _hands(rows: GraspRows, part: slice, hand: HandArrays, obj: ObjectModel) -> tuple[np.ndarray, np.ndarray]:
    """T_hand_object of the object's internal frame (n, 7), and joints within their limits (n, K); row by row, so that
    none depends on the others."""
    tree = hand.model.tree
    q = np.clip(np.asarray(rows.q)[part, : hand.model.dofs], tree.joint_lower, tree.joint_upper)
    pose = internal_poses(np.asarray(rows.object_pose)[part, 0], obj.center)
    return pose, np.ascontiguousarray(q, np.float32)


def _kept(old: GraspRows, new: GraspRows, take: np.ndarray, measured: bool) -> GraspRows:
    """``new`` with the stored rows of ``old`` but those to ``take``; of rows that are not ``measured`` by the same
    bounds, postures and poses alone.

    Verdicts of a simulator are dropped: they are of the old rows.
    """
    changes, width = {}, max(np.shape(rows.contact_links)[2] for rows in (old, new))
    for name in (*POSTURES, "object_pose", *CONTACTS) if measured else ("q", "object_pose"):
        x, y = (np.asarray(getattr(rows, name)) for rows in (old, new))
        if name in CONTACTS:
            x, y = (padded(v, (v.shape[1], width, *v.shape[3:])) for v in (x, y))
        changes[name] = _chosen(take, y, x)
    if not measured:
        return replace(new, **changes)
    metrics = {
        name: np.where(take, values, old.metrics[name]) if name in {*old.metrics} - _TOLD else values
        for name, values in new.metrics.items()
    }
    table = {name: _chosen(take, values, np.asarray(old.table[name])) for name, values in new.table.items()}
    return replace(new, **changes, metrics=metrics, table=table)


def _chosen(take: np.ndarray, new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """Rows (N, ...) of ``new`` where ``take`` (N,) says so, else of ``old``."""
    return np.where(take.reshape(-1, *(1,) * (old.ndim - 1)), new, old).astype(old.dtype)
