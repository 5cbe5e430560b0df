"""Rows are counted as valid by what is stored of them."""

import numpy as np
import pytest

from lgrasp.grasp.bounds import GraspBounds

GOOD = {"gap": 0.001, "normal_error": np.radians(16), "penetration": 0.0005, "gswo": 0.03, "unresisted_load": 0.5}


def rows(**changes):
    """One good row, and one for each change."""
    table = [GOOD] + [GOOD | {name: value} for name, value in changes.items()]
    return {name: np.array([row[name] for row in table], np.float32) for name in GOOD}


def test_each_bound_leaves_out_the_row_beyond_it():
    bounds = GraspBounds(max_unresisted_load=0.6)
    beyond = rows(gap=0.0014, normal_error=np.radians(18), penetration=0.0009, gswo=0.04, unresisted_load=0.7)
    assert bounds.met_by(beyond).tolist() == [True, False, False, False, False, False]


def test_a_load_is_bounded_only_where_bounds_say_so():
    assert GraspBounds().met_by(rows(unresisted_load=0.99)).all()


def test_rows_at_a_bound_meet_it():
    bounds = GraspBounds()
    assert bounds.met_by(rows(gap=bounds.max_gap, penetration=bounds.max_penetration)).all()


def test_a_missing_metric_is_no_valid_row():
    with pytest.raises(KeyError, match="gswo"):
        GraspBounds().met_by({name: x for name, x in rows().items() if name != "gswo"})


def test_looser_numbers_are_told_beside_the_profile():
    assert GraspBounds(friction=0.4, min_contacts=3, max_penetration=0.0005).told == "strict"
    assert GraspBounds(profile="plan", friction=0.4).told == "plan"
    told = GraspBounds(friction=0.8, max_penetration=0.002, min_self_distance=0.0).told
    assert told == "strict, but for max_penetration, min_self_distance, friction"
