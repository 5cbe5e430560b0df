"""The check of hands whose contacts must be found first."""

import numpy as np
import pytest

from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.check import check_grasps
from lgrasp.grasp.find_contacts import find_contacts
from lgrasp.grasp.outcomes import Outcome
from lgrasp.refine.refiner import object_pose


def searched(inputs, pose, q):
    """The check of hands whose contacts are found, not told."""
    contacts = find_contacts(inputs.hand, inputs.object, pose, q, GraspBounds())
    return check_grasps(inputs.hand, inputs.object, pose, q, contacts, GraspBounds())


@pytest.fixture(scope="module")
def checked(inputs, filtered):
    return searched(inputs, filtered.pose, filtered.q)


def test_rows_of_filter_collide_with_nothing(checked, filtered):
    table, outcome = checked
    assert not np.isin(outcome, [Outcome.SELF_COLLISION, Outcome.OBJECT_COLLISION]).any()
    np.testing.assert_array_equal(table.metrics["penetration"], filtered.metrics["penetration"])
    np.testing.assert_array_equal(table.metrics["self_penetration"], filtered.metrics["self_penetration"])


def test_contacts_of_valid_grasps_are_found(checked):
    """Hands that are valid with the contacts that they were made for are valid without being told of them."""
    assert (checked[1] == Outcome.KEPT).mean() > 0.9


def test_contacts_lie_on_the_object(checked, inputs):
    table, outcome = checked
    obj = inputs.object.model
    points = table.contact_points[outcome == 0].reshape(-1, 3)
    points = points[np.isfinite(points).all(1)]
    gap = np.linalg.norm(points[:, None] - obj.obstacle_points[None], axis=2).min(1)
    assert np.quantile(gap, 0.99) < 0.004  # of points that are some 2 mm apart


def test_forces_balance(checked):
    """Normal parts sum to one, and the net force is below the residual allowed."""
    table, outcome = checked
    force, normal = (np.nan_to_num(a[outcome == 0]) for a in (table.contact_forces, table.contact_normals))
    np.testing.assert_allclose(-(force * normal).sum((1, 2)), 1, atol=1e-3)
    assert np.linalg.norm(force.sum(1), axis=1).max() < GraspBounds().max_gswo + 1e-3


def test_a_hand_in_the_object_is_told(inputs, filtered, make, valid):
    refiner = make()
    _, n = refiner.target.nearest(refiner.middle(valid.R, valid.t))
    pose = object_pose(valid.R, valid.t - 0.006 * n)
    table, outcome = searched(inputs, pose, filtered.q)
    deep = table.metrics["penetration"] > 0.002
    assert deep.mean() > 0.6
    assert (outcome[deep] != 0).all()
    np.testing.assert_array_equal(
        deep[(refiner.max_penetration(*valid._replace(t=valid.t - 0.006 * n)) > 0.0025).numpy()], True
    )
