"""Plans: the best hand of each start."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from lgrasp.cloud.model import cloud_object
from lgrasp.grasp.check import check_grasps, compare_grasps, known_contacts
from lgrasp.grasp.outcomes import FAILED_BOUNDS, NOT_HELD, REASONS, Outcome
from lgrasp.hold.params import HoldTest
from lgrasp.hold.run import ControlPoses, HoldTester
from lgrasp.planning.params import PlanParams
from lgrasp.planning.planner import Planned, Planner
from lgrasp.refine.params import LocalSearch

QUICK = PlanParams(
    rolls=3, finalists=1, opening=2, search=PlanParams().search.model_copy(update={"matching_rounds": 6})
)
STARTS = 24


@pytest.fixture(scope="module")
def planner(inputs) -> Planner:
    return Planner(inputs.hand, inputs.object.model, 0.12, QUICK)


@pytest.fixture(scope="module")
def planned(planner):
    return planner.run(8)


def test_every_start_is_accounted_for(planned):
    counts = planned.counts
    assert counts["starts"] == 8 == counts["colliding"] + sum(counts[name] for name in (*REASONS, NOT_HELD))
    assert counts["kept"] == len(planned.grasps) == len(set(planned.grasps.index)) > 0


def test_plans_satisfy_their_bounds(planned):
    metrics, bounds = planned.grasps.metrics, QUICK.bounds
    assert metrics["penetration"].max() <= bounds.max_penetration
    assert metrics["gap"].max() <= bounds.max_gap
    assert ((planned.grasps.contact_links >= 0).sum(1) >= 2).all()


def test_every_plan_passes_the_check_with_the_contacts_stored(planner, planned, inputs):
    table = planned.grasps
    contacts = known_contacts(table.contact_links, table.contact_points, table.contact_normals, "cpu")
    _, outcome = check_grasps(inputs.hand, inputs.object, table.pose, table.q, contacts, QUICK.bounds)
    assert (outcome == Outcome.KEPT).all()
    every = planner.run(8, keep_invalid=True).grasps
    assert len(every) == planned.counts["starts"] - planned.counts["colliding"]
    np.testing.assert_array_equal(every.q[every.metrics["valid"] == 1], table.q)


def test_hands_are_compared_by_what_the_check_finds(planner, inputs):
    table = planner.run(8, keep_invalid=True).grasps
    contacts = known_contacts(table.contact_links, table.contact_points, table.contact_normals, "cpu")
    hands = inputs.hand, inputs.object, table.pose, table.q, contacts, QUICK.bounds
    whole, outcome = check_grasps(*hands)
    found = compare_grasps(*hands)
    np.testing.assert_array_equal(found.outcome, outcome)
    for name in ("unresisted_load", "penetration"):
        np.testing.assert_array_equal(getattr(found, name), whole.metrics[name])
    assert len(set(outcome.tolist())) > 1


def test_where_control_poses_are_bounded_the_best_that_meets_them_is_the_plan(inputs):
    """Of those compared first many fail what only control poses show."""
    params = QUICK.model_copy(update={"rolls": 12, "finalists": 12, "tried": 0})
    least = float(np.median(Planner(inputs.hand, inputs.object.model, 0.12, params).run(20).grasps.metrics["epsilon"]))
    bounded = params.model_copy(update={"bounds": params.bounds.changed(min_epsilon=least)})
    table = Planner(inputs.hand, inputs.object.model, 0.12, bounded).run(20).grasps
    assert len(table) > 10
    assert table.metrics["epsilon"].min() >= least


def test_a_start_does_not_depend_on_the_others(planner, planned):
    few = planner.run(4)
    same = planned.grasps.index < 4
    np.testing.assert_array_equal(few.grasps.index, planned.grasps.index[same])
    np.testing.assert_array_equal(few.grasps.q, planned.grasps.q[same])
    np.testing.assert_array_equal(few.grasps.pose, planned.grasps.pose[same])


@pytest.fixture(scope="module")
def barrett(load, swift):
    """A hand of which few starts tell: most of its plans hold, some do not."""
    return load("mug", swift, "barrett")


@pytest.fixture(scope="module")
def plan(barrett) -> Callable[..., Planned]:
    """plan(tried, draws): what is planned of all starts, of fewer none may differ."""

    @cache
    def plan(tried: int, draws: int = 0) -> Planned:
        several = {"rolls": 12, "finalists": 12, "tried": tried, "hold": HoldTest(draws=draws)}
        params = QUICK.model_copy(update=several)
        return Planner(barrett.hand, barrett.object.model, 0.12, params).run(STARTS)

    return plan


def test_of_several_hands_the_plan_is_one_that_holds_most_often(barrett, plan):
    draws = 4
    tester = HoldTester(barrett.hand, barrett.object, HoldTest(draws=draws))

    def shares(table):
        found = tester.run(ControlPoses.of(table), 0)
        share = (found["hold_success"] + draws * found["hold_probability"]) / (1 + draws)
        return dict(zip(table.index.tolist(), share.tolist(), strict=True))

    plans, first = plan(12, draws).grasps, plan(0).grasps  # without a try, draws say nothing
    tried, untried, alone = shares(plans), shares(first), shares(plan(1, draws).grasps)
    assert tried.keys() == untried.keys()
    assert all(tried[start] >= share for start, share in untried.items())
    assert sum(tried.values()) > sum(untried.values())
    assert alone == untried  # one hand of each start is the best, however often it holds
    always = [untried[start] == 1 for start in first.index.tolist()]  # where the best always holds, it is the plan
    np.testing.assert_array_equal(plans.q[always], first.q[always])


def test_of_a_plane_nothing_is_tried(inputs):
    """A cloud of one flat face has no mass; its plans are ranked without."""
    points = np.random.default_rng(0).uniform(-0.03, 0.03, (500, 3)) * [1, 1, 0]
    face = cloud_object(points, np.tile([0.0, 0, 1], (500, 1)))
    assert Planner(inputs.hand, face, 0.12, QUICK).run(2).counts["starts"] == 2


def test_parameters_are_bounded():
    with pytest.raises(ValueError, match="greater than"):
        LocalSearch(max_translation_step=0)


def test_hands_that_hold_less_often_are_drawn_and_tried_more_often_unless_told():
    few, many, opened = (PlanParams().effort(fingers) for fingers in (3, 4, None))
    assert few.draws > many.draws
    assert opened.finalists == 10
    rounds = [effort.search.matching_rounds for effort in (opened, few, many)]
    assert rounds[0] == rounds[1] == PlanParams().search.matching_rounds > rounds[2]
    assert opened.bounds == PlanParams().bounds
    unsure = PlanParams().effort(4, unsure=True)
    assert unsure.draws > many.draws
    assert 0 < unsure.bounds.min_hold_probability < many.bounds.min_hold_probability
    assert few.bounds == unsure.bounds == PlanParams().effort(3, unsure=True).bounds
    numbers = {"draws": 6, "finalists": 2, "tried": 0}
    told = PlanParams(**numbers, matching_rounds=7, hold=HoldTest(draws=5), min_hold_probability=0.0)
    for effort in (told.effort(fingers) for fingers in (3, 4, None)):
        assert effort._asdict().items() >= numbers.items()
        assert effort.hold.draws == 5
        assert effort.search.matching_rounds == 7
        assert effort.bounds.min_hold_probability == 0
    told = PlanParams(bounds=PlanParams().bounds.changed(min_hold_probability=0.5))
    assert told.effort(4).bounds == told.bounds


def test_hands_that_do_not_hold_as_often_as_is_asked_are_no_plans(barrett, plan):
    """Of each start the best stays a plan if it holds so often, else it is counted; none may be another."""
    params = QUICK.model_copy(update={"rolls": 12, "finalists": 12, "tried": 12, "hold": HoldTest(draws=4)})
    strict = params.model_copy(update={"min_hold_probability": 0.75})
    free = plan(12, 4)
    planner = Planner(barrett.hand, barrett.object.model, 0.12, strict)
    asked = planner.run(STARTS, keep_invalid=True)
    assert 0 < asked.counts[NOT_HELD] == free.counts["kept"] - asked.counts["kept"] < free.counts["kept"]
    assert free.counts[NOT_HELD] == 0
    found = HoldTester(barrett.hand, barrett.object, params.hold).run(ControlPoses.of(asked.grasps), 0)
    valid = asked.grasps.metrics["valid"] == 1
    assert valid.sum() == asked.counts["kept"]
    assert found["hold_success"][valid].all()
    assert (found["hold_probability"][valid] >= 0.75).all()
    lost = asked.grasps.metrics["failed_bound"] == FAILED_BOUNDS.index("min_hold_probability")
    assert lost.sum() == asked.counts[NOT_HELD]
    assert not valid[lost].any()
    untried = strict.model_copy(update={"tried": 0})
    first = Planner(barrett.hand, barrett.object.model, 0.12, untried).run(12).grasps.index
    assert (first == [start for start in free.grasps.index if start < 12]).all()  # who tries nothing refuses nothing
