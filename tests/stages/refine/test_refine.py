"""Stage refine: rows that became better by checks of their own, none lost."""

from types import SimpleNamespace

import numpy as np
import pytest

from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.tables import take_grasps
from lgrasp.stages.refine import stage
from lgrasp.stages.refine.params import RefineParams


@pytest.fixture(scope="module")
def refined(tables, context) -> SimpleNamespace:
    before = take_grasps(tables.filter, np.arange(60))
    after, counts = stage.run(before, RefineParams(), context)
    changed = (before.q != after.q).any(1) | (before.pose != after.pose).any(1)
    return SimpleNamespace(before=before, after=after, counts=counts, changed=changed)


def test_no_row_is_lost_and_some_are_replaced(refined):
    assert len(refined.after) == refined.counts["tried"] == 60
    assert refined.changed.sum() == refined.counts["replaced"] > 3
    assert refined.counts["replaced"] <= refined.counts["passed"] <= 60
    np.testing.assert_array_equal(refined.after.index, refined.before.index)
    np.testing.assert_array_equal(refined.after.slot, refined.before.slot)


def test_replaced_rows_resist_better_within_the_bounds(refined):
    before, after, bounds = refined.before.metrics, refined.after.metrics, GraspBounds()
    assert (after["unresisted_load"][refined.changed] < before["unresisted_load"][refined.changed]).all()
    for name, most in (("penetration", bounds.max_penetration), ("gap", bounds.max_gap), ("gswo", bounds.max_gswo)):
        assert after[name].max() <= most + 1e-6, name


def test_other_rows_are_as_they_were(refined):
    same = ~refined.changed
    for name in ("q_pregrasp", "q_squeeze"):
        np.testing.assert_array_equal(getattr(refined.after, name)[same], getattr(refined.before, name)[same])
    links = refined.before.contact_links.shape[1]
    np.testing.assert_array_equal(refined.after.contact_links[same, :links], refined.before.contact_links[same])
    assert (refined.after.contact_links[same, links:] == -1).all()


def test_contacts_touch_the_links_they_name(refined, link_poses, link_distance, device_matrix):
    """An independent reader of the URDF finds every contact of a replaced row on its link."""
    after = refined.after
    rows, slots = np.nonzero((after.contact_links >= 0) & refined.changed[:, None])
    T_link = link_poses(after.q)
    T_object = device_matrix(after.pose.astype(float))
    for row, slot in zip(rows, slots, strict=True):
        p = T_object[row] @ np.append(after.contact_points[row, slot], 1)
        link = int(after.contact_links[row, slot])
        own = np.linalg.inv(T_link[row, link]) @ p
        assert abs(link_distance(link, own[None, :3])[0]) < 0.002


def test_rows_do_not_depend_on_the_batch(refined, context):
    part, _ = stage.run(take_grasps(refined.before, np.arange(7, 12)), RefineParams(), context)
    np.testing.assert_array_equal(part.q, refined.after.q[7:12])


def test_no_rows(tables, context):
    none = take_grasps(tables.filter, np.zeros(0, int))
    after, counts = stage.run(none, RefineParams(), context)
    assert len(after) == 0
    assert counts == {"tried": 0, "passed": 0, "replaced": 0}
