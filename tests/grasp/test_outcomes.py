"""Which bound a row fails first, in a word that is true."""

from collections import defaultdict
from types import SimpleNamespace

import numpy as np

from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.outcomes import FAILED_BOUNDS, Outcome, failed_bounds


def test_contacts_that_fail_name_the_bound():
    """Links 0 and 1 are one finger, 2 another, 3 is the palm; normals may fail beside an edge alone."""
    links = np.array([[0, 2, -1], [0, 3, -1], [0, 1, -1], [0, -1, -1], [3, -1, -1], [-1, -1, -1], [0, 1, 2]])
    metrics = defaultdict(lambda: np.zeros(len(links)), gap=np.where(np.arange(len(links)) == 6, 1.0, 0.0))
    vectors = np.zeros((*links.shape, 3))
    table = SimpleNamespace(contact_links=links, contact_forces=vectors, contact_normals=vectors, metrics=metrics)
    codes = failed_bounds(table, np.full(len(links), Outcome.CONTACT), GraspBounds(), np.array([0, 0, 1, -1]))
    few, steep = "min_contacts", "max_normal_angle"
    assert [FAILED_BOUNDS[int(code)] for code in codes] == [steep, steep, few, few, few, few, "max_gap"]
