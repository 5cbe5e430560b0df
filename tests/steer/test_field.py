"""Contact fields in which only some of the hand's surface is found."""

import numpy as np

from lgrasp.math.transforms import NORMAL_BINS
from lgrasp.steer.field import steered_field
from lgrasp.steer.params import NOTHING, Steering
from lgrasp.steer.touch import find_touching


def found(field):
    """Rows of the contact vectors that a query can find, and their slots."""
    bits = np.unpackbits(field.mask.view(np.uint8), bitorder="little").astype(bool)
    rows = np.flatnonzero(bits.repeat(np.diff(field.start)))
    ends = field.start[field.cell_first.astype(int) * NORMAL_BINS]
    return rows, np.searchsorted(ends, rows, "right") - 1


def test_nothing_asked_changes_nothing(inputs):
    field, hand = inputs.field.model, inputs.hand.model
    same = steered_field(field, find_touching(NOTHING, hand, {}))
    for name, values in field.to_arrays().items():
        np.testing.assert_array_equal(getattr(same, name), values)


def test_only_what_may_touch_is_found(inputs):
    """Postures of the others stay: unused fingers take them."""
    field, hand = inputs.field.model, inputs.hand.model
    touching = find_touching(Steering(fingers=("link_3.0_tip", "link_15.0_tip")), hand, {})
    steered = steered_field(field, touching)
    rows, slots = found(steered)
    assert set(np.flatnonzero(touching.groups)) == set(slots)
    assert touching.points[steered.point[rows]].all()
    all_rows, all_slots = found(field)
    assert len(rows) == touching.groups[all_slots].sum() < len(all_rows)
    assert steered.vectors == field.vectors
    assert touching.groups[steered.pair_slot].all()
    assert 0 < len(steered.pair_slot) < len(field.pair_slot)


def test_part_of_a_finger(inputs):
    """Contact vectors on the other part are gone, and the rest are where they were."""
    field, hand = inputs.field.model, inputs.hand.model
    touching = find_touching(NOTHING, hand, {})
    touching.points[: hand.contact_first[1] : 2] = False  # every second point of the first finger
    steered = steered_field(field, touching)
    kept = touching.points[field.point]
    for name in ("point", "offset", "normal", "posture"):
        np.testing.assert_array_equal(getattr(steered, name), getattr(field, name)[kept])
    cells, own = ((np.searchsorted(f.start, np.arange(f.vectors), "right") - 1) for f in (field, steered))
    np.testing.assert_array_equal(own, cells[kept])
    assert len(found(steered)[0]) == kept.sum()
