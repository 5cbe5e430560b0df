"""Rows of one object moved by a local search, checked, and kept where they became better."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from lgrasp.dataset import GraspRows
from lgrasp.geometry.poses import pose_matrix
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.check import check_grasps
from lgrasp.grasp.find_contacts import find_contacts
from lgrasp.grasp.rows import grasp_rows, press
from lgrasp.grasp.tables import GraspTable, grasp_arrays, grasps_from_arrays, join_grasps
from lgrasp.hand.arrays import HandArrays
from lgrasp.object.arrays import ObjectArrays, upload_object
from lgrasp.object.model import ObjectModel
from lgrasp.refine.energy import Energies
from lgrasp.refine.refiner import Pose, Refiner, object_pose
from lgrasp.stages.refine.params import RefineParams

_ROWS = 256  # at a time
_FAR = 0.5  # [m] from the object: nothing pulls there
_BETTER = 1e-3  # of a unit pull that must be resisted more to replace a valid row
_LIMIT = 1e-4  # [rad or m] that a joint may be outside its limits


class Moved(NamedTuple):
    """What became of rows."""

    rows: GraspRows
    """In their order, with metrics ``energy`` and its terms at the posture stored, ``valid`` (passes every check) and
    ``refined`` (the posture is the refined one)."""
    energy: tuple[float, float]
    """Mean E* before and after the search."""
    valid: tuple[int, int]
    """Rows that pass every check, before and as stored."""
    clamped: int
    """Rows whose joints were outside their limits; they are moved, and kept where they stay, from within."""
    far: int
    """Rows whose hand is too far from the object to be drawn to it."""


def move_rows(
    hand: HandArrays,
    obj: ObjectModel,
    rows: GraspRows,
    params: RefineParams,
    bounds: GraspBounds,
    *,
    always: bool = False,
    stored: bool = True,
    progress: Callable[[int], None] | None = None,
) -> Moved:
    """Refine rows of one object.

    A refined row takes the place of the one given where it passes every check, and that does not or resists pulls less,
    by what is stored of it too.

    Args:
        always: every row takes the refined posture.
        stored: rows that are not replaced stay as they are, metrics and contacts included; else all is computed.
        progress: called with rows done.
    """
    refiner = Refiner(hand.model, obj, params, device=hand.device)
    arrays = upload_object(obj, hand.device)
    outside = _outside(rows, hand)
    known = np.asarray(rows.metrics.get("unresisted_load", np.full(len(rows), np.nan))) if stored else None
    parts, before, after, oks = [], [], [], []
    far = 0
    for first in range(0, len(rows), _ROWS):
        part = slice(first, first + _ROWS)
        given = _hands(rows, part, hand, obj)
        refined = refiner(*given)
        index = np.arange(len(rows))[part]
        old, old_outcome = _checked(hand, arrays, given, bounds, index)
        new, new_outcome = _checked(hand, arrays, refined.pose, bounds, index)
        good, was = new_outcome == 0, old_outcome == 0
        least = (
            old.metrics["unresisted_load"] if known is None else np.fmin(old.metrics["unresisted_load"], known[part])
        )
        lower = new.metrics["unresisted_load"] < least - _BETTER
        take = np.ones_like(good) if always else good & (~was | lower)
        energies = _numbers(refiner.energy(*given)), _numbers(refined.energies)
        before.append(energies[0])
        after.append(np.where(take, energies[1], energies[0]))
        parts.append((_mixed(old, new, take), take, np.where(take, good, was)))
        oks.append((was, np.where(take, good, was)))
        far += int((_distance(given, refiner) > _FAR).sum())
        if progress:
            progress(min(first + _ROWS, len(rows)))
    table = join_grasps([p[0] for p in parts])
    take, valid = (np.concatenate([p[k] for p in parts]) for k in (1, 2))
    first_energy, last_energy = np.concatenate(before, 1), np.concatenate(after, 1)
    terms = {f"energy_{name}": values for name, values in zip(Energies._fields, last_energy, strict=True)}
    extra = {"energy": last_energy.sum(0), **terms, "valid": valid, "refined": take}
    extra = {name: np.asarray(values, np.float32) for name, values in extra.items()}
    made = grasp_rows(press(table), hand.model.tree, obj.center, extra=extra)
    made = replace(made, candidate=rows.candidate)
    if stored:
        made = _kept(rows, made, take | outside)
    was = np.concatenate([ok[0] for ok in oks])
    means = float(first_energy.sum(0).mean()), float(last_energy.sum(0).mean())
    return Moved(made, means, (int(was.sum()), int(valid.sum())), int(outside.sum()), far)


def _checked(
    hand: HandArrays, obj: ObjectArrays, at: Pose, bounds: GraspBounds, index: np.ndarray
) -> tuple[GraspTable, np.ndarray]:
    pose, q = object_pose(at), at.q.cpu().numpy()
    return check_grasps(hand, obj, pose, q, find_contacts(hand, obj, pose, q, bounds), bounds, index=index)


def _outside(rows: GraspRows, hand: HandArrays) -> np.ndarray:
    """Rows with joints outside their limits, (N,) bool."""
    limits, q = hand.model.tree.listed_limits, np.asarray(rows.q)
    return np.asarray(((q < limits[:, 0] - _LIMIT) | (q > limits[:, 1] + _LIMIT)).any(1))


def _hands(rows: GraspRows, part: slice, hand: HandArrays, obj: ObjectModel) -> Pose:
    """The hands of rows in the object's internal frame, joints within their limits."""
    T = pose_matrix(np.asarray(rows.object_pose, float)[part, 0])  # base from the user's frame
    R = T[:, :3, :3].transpose(0, 2, 1)
    t = -(R @ T[:, :3, 3:])[..., 0] - obj.center
    tree = hand.model.tree
    q = np.clip(np.asarray(rows.q)[part, : hand.model.dofs], tree.joint_lower, tree.joint_upper)
    return Pose(*(torch.as_tensor(np.ascontiguousarray(a), dtype=torch.float32, device=hand.device) for a in (R, t, q)))


def _distance(pose: Pose, refiner: Refiner) -> np.ndarray:
    """Of the middle of the palmar side from the object [m], (N,)."""
    return refiner.target.nearest(refiner.middle(pose.R, pose.t))[0].cpu().numpy()


def _numbers(energies: Energies) -> np.ndarray:
    """Terms, (6, N)."""
    return torch.stack(list(energies)).detach().cpu().numpy()


def _mixed(old: GraspTable, new: GraspTable, take: np.ndarray) -> GraspTable:
    a, b = grasp_arrays(old), grasp_arrays(new)
    return grasps_from_arrays(
        {name: np.where(take.reshape(-1, *(1,) * (x.ndim - 1)), b[name], x).astype(x.dtype) for name, x in a.items()}
    )


def _kept(old: GraspRows, new: GraspRows, take: np.ndarray) -> GraspRows:
    """``new`` with the stored rows of ``old`` but those to ``take``. Verdicts of a simulator are dropped: they are of
    the old rows."""
    changes = {}
    for name in ("q", "q_pregrasp", "q_squeeze", "object_pose"):
        keep = (~take).reshape(-1, *(1,) * (np.ndim(getattr(old, name)) - 1))
        changes[name] = np.where(keep, getattr(old, name), getattr(new, name)).astype(np.float32)
    names = ("contact_points", "contact_normals", "contact_links", "contact_forces")
    width = max(np.shape(old.contact_links)[2], np.shape(new.contact_links)[2])
    for name in names:
        x, y = (_padded(np.asarray(getattr(rows, name)), width) for rows in (old, new))
        changes[name] = np.where((~take).reshape(-1, *(1,) * (x.ndim - 1)), x, y).astype(x.dtype)
    metrics = {
        name: np.where(take, values, old.metrics[name]) if name in old.metrics else values
        for name, values in new.metrics.items()
    }
    return replace(new, **changes, metrics=metrics)


def _padded(x: np.ndarray, width: int) -> np.ndarray:
    none = -1 if x.dtype.kind == "i" else np.nan
    pad = [(0, 0), (0, 0), (0, width - x.shape[2])] + [(0, 0)] * (x.ndim - 3)
    return np.pad(x, pad, constant_values=none)
