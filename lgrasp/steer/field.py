"""A contact field in which only some of a hand's contact surface is found."""

from dataclasses import replace

import numpy as np

from lgrasp.field.model import ContactField
from lgrasp.math.transforms import NORMAL_BINS
from lgrasp.steer.touch import Touching


def steered_field(field: ContactField, touching: Touching) -> ContactField:
    """The field without the contact vectors of points that may not touch.

    Vectors of fingers that may not touch at all stay, as postures that unused fingers may take; no query finds them.
    """
    groups = len(touching.groups)
    found = touching.points[field.point]
    rows = field.start[field.cell_first.astype(np.int64) * NORMAL_BINS]
    group = np.repeat(np.arange(len(rows) - 1) % groups, np.diff(rows))
    kept = found | ~touching.groups[group]
    upto = np.concatenate([[0], np.cumsum(kept)])
    any_found = np.diff(np.concatenate([[0], np.cumsum(found)])[field.start]) > 0
    mask = np.packbits(any_found.reshape(-1, NORMAL_BINS), axis=1, bitorder="little").view(np.uint64).ravel()
    leaf = found[field.leaf_record]
    return replace(
        field,
        start=upto[field.start].astype(np.int32),
        mask=mask,
        **{name: getattr(field, name)[kept] for name in ("point", "offset", "normal", "posture")},
        **_pairs(field, touching),
        leaf_first=np.concatenate([[0], np.cumsum(leaf)])[field.leaf_first].astype(np.int32),
        leaf_record=upto[field.leaf_record[leaf]].astype(np.int32),
    )


def _pairs(field: ContactField, touching: Touching) -> dict[str, np.ndarray]:
    """The pairs whose two sides may touch; a slot below 0 is a point of the palm."""
    slot, groups = field.pair_slot, len(touching.groups)
    palm = touching.points[np.where(slot < 0, -1 - slot, 0)]
    kept = np.where(slot < 0, palm, touching.groups[slot % groups]).all(1)
    return {name: getattr(field, name)[kept] for name in ("pair_point", "pair_normal", "pair_slot", "pair_width")}
