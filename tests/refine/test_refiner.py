"""What the refiner promises: true gradients, samples by themselves, hands that leave the object and fit it."""

from copy import deepcopy

import numpy as np
import pytest
import torch

from lgrasp.errors import ConfigError
from lgrasp.geometry.rotations import so3_exp
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.check import check_grasps
from lgrasp.grasp.find_contacts import find_contacts
from lgrasp.refine.refiner import Pose, object_pose


def some(pose: Pose, rows: slice, dtype: torch.dtype = torch.float32) -> Pose:
    return Pose(*(x[rows].to(dtype) for x in pose))


@pytest.fixture(scope="module")
def exact(make, valid, coarse):
    """A refiner in float64 with two coarse hands: rotation vector, position, joints, and the rotations they turn."""
    refiner = make(torch.float64)
    pose = some(coarse(valid), slice(2), torch.float64)
    q = pose.q.maximum(refiner.lower + 0.01).minimum(refiner.upper - 0.01)
    turn = torch.zeros(2, 3, dtype=torch.float64)
    return refiner, pose.R, [x.detach().requires_grad_() for x in (turn, pose.t, q)]


def test_gradient_of_every_term(exact):
    refiner, R, inputs = exact
    matches = refiner.match(R, inputs[1], inputs[2])

    def energy(turn, t, q):
        return torch.stack(list(refiner.energy(so3_exp(turn) @ R, t, q, matches=matches)))

    assert torch.autograd.gradcheck(energy, inputs)


def test_gradient_through_unrolled_steps(exact):
    refiner, R, inputs = exact
    R, inputs = R[:1], [x.detach()[:1].requires_grad_() for x in inputs]
    matches = refiner.match(R, inputs[1], inputs[2])

    def moved(turn, t, q):
        pose = refiner.unrolled(so3_exp(turn) @ R, t, q, steps=2, matches=matches)
        return torch.cat([x.flatten() for x in pose])

    assert torch.autograd.gradcheck(moved, inputs, fast_mode=True)


def test_a_sample_does_not_depend_on_the_others(make, valid, coarse):
    refiner, pose = make(matching_rounds=3), coarse(valid)
    whole, part = refiner(*some(pose, slice(9))).pose, refiner(*some(pose, slice(4, 6))).pose
    for a, b in zip(whole, part, strict=True):
        torch.testing.assert_close(a[4:6], b, rtol=0, atol=0)


def test_energy_of_coarse_poses_falls(make, valid, coarse):
    refiner, pose = make(matching_rounds=13, reach=0.05, reach_end=0.03), some(coarse(valid), slice(24))
    before = refiner.energy(*pose).total.mean()
    found = refiner(*pose)
    after = found.energies.total.mean()
    assert after < before / 3
    torch.testing.assert_close(found.energies.total, refiner.energy(*found.pose).total)


def test_penetration_is_left(make, valid, inputs):
    """Hands pushed 6 mm into the mug, whose walls are thinner than that, come out to less than 1 mm."""
    refiner = make()
    _, n = refiner.target.nearest(refiner.middle(valid.R, valid.t))
    into = valid._replace(t=valid.t - 0.006 * n)
    deep = refiner.max_penetration(*into) > 0.004
    assert deep.sum() > 10
    found = refiner(*(x[deep] for x in into)).pose
    pose, q, bounds = object_pose(found.R, found.t), found.q.numpy(), GraspBounds()
    contacts = find_contacts(inputs.hand, inputs.object, pose, q, bounds)
    table, _ = check_grasps(inputs.hand, inputs.object, pose, q, contacts, bounds)
    assert np.quantile(table.metrics["penetration"], 0.9) < 0.001


def test_hands_that_are_not_finite_have_no_depth(make, valid):
    refiner, pose = make(), some(valid, slice(3))
    for name, value in (("t", torch.nan), ("q", torch.inf)):
        changed = getattr(pose, name).clone()
        changed[1, 0] = value
        depth = refiner.max_penetration(*pose._replace(**{name: changed}))
        assert depth.isnan().tolist() == [False, True, False]


def test_hands_are_taken_out_before_the_search(make, valid, coarse):
    """Coarse hands through the mug's walls come free, by opening where a straight way is not enough; others stay."""
    tiny = {"matching_rounds": 1, "gradient_steps": 1}
    tiny |= {f"max_{kind}_step": 1e-9 for kind in ("translation", "rotation", "joint")}
    refiner, pose = make(**tiny), some(coarse(valid), slice(50))
    before, moved = refiner.max_penetration(*pose), refiner(*pose).pose
    deep, q = before > 0.002, pose.q.maximum(refiner.lower).minimum(refiner.upper)
    assert deep.float().mean() > 0.3
    assert (refiner.max_penetration(*moved)[deep] < 0.002).float().mean() > 0.95
    shift = (moved.t - pose.t).norm(dim=1)
    assert shift.max() < 4 * refiner.params.max_exit_distance + 1e-5
    straight = deep & (moved.q - q).abs().amax(1).lt(1e-6)
    assert shift[straight].max() < refiner.params.max_exit_distance + 1e-5
    again = refiner.max_penetration(pose.R, pose.t, q) < 0.0019
    torch.testing.assert_close(moved.t[again], pose.t[again], rtol=0, atol=1e-6)
    for still in (make(**tiny, max_exit_distance=0.0)(*pose).pose, refiner(*pose, rounds=0).pose):
        torch.testing.assert_close(still.t, pose.t, rtol=0, atol=1e-6)


def test_unrolled_steps_stay_rotations_and_lower_the_energy(make, valid, coarse):
    refiner, pose = make(), some(coarse(valid), slice(16))
    matches = refiner.match(*pose)
    moved = refiner.unrolled(*pose, steps=5, matches=matches)
    eye = torch.eye(3).expand(16, 3, 3)
    torch.testing.assert_close(moved.R @ moved.R.mT, eye, rtol=0, atol=1e-5)
    assert refiner.energy(*moved, matches=matches).total.mean() < refiner.energy(*pose, matches=matches).total.mean()


def test_hands_that_are_none(make, valid):
    """A hand with NaN stays NaN and alone; other shapes and types are refused in one line."""
    refiner, pose = make(matching_rounds=2), some(valid, slice(4))
    use = (lambda *x: refiner(*x).pose.t, lambda *x: refiner.energy(*x).total, lambda *x: refiner.unrolled(*x).t)
    for given in (pose._replace(t=pose.t.clone()), pose._replace(q=pose.q.clone())):
        given[1 if given.t is not pose.t else 2][1, 0] = torch.nan
        for f in use:
            right, found = f(*pose), f(*given)
            assert found[1].isnan().all()
            torch.testing.assert_close(found[[0, 2, 3]], right[[0, 2, 3]])
    R, t, q = pose
    for wrong in ((R.double(), t.double(), q.double()), (R, t, q[:, :5]), (R[0], t[0], q[0]), (R, t[:1], q), (R, t, 0)):
        for f in (*use, refiner.match, refiner.max_penetration):
            with pytest.raises(
                ConfigError, match=r"^[Rtq] is .*; of \d hands a tensor \(\d.* of torch.float32 is accepted"
            ):
                f(*wrong)


def test_copies_and_a_module_that_is_moved(make, valid):
    """A refiner stays of its type, and a copy of one that was used does the same."""
    refiner, pose = make(matching_rounds=2), some(valid, slice(2))
    found = refiner(*pose)
    copy = deepcopy(torch.nn.ModuleList([refiner]).double())[0]
    torch.testing.assert_close(copy(*pose).pose.t, found.pose.t)
    torch.testing.assert_close(refiner.energy(*pose).total, copy.energy(*pose).total)


def test_joints_stay_in_their_limits(make, valid):
    refiner = make(matching_rounds=2)
    pose = some(valid, slice(4))
    found = refiner(pose.R, pose.t, pose.q + 5).pose.q
    assert (found <= refiner.upper).all()
    assert (found >= refiner.lower).all()


def test_sgd_refines_too(make, valid, coarse):
    refiner, pose = make(matching_rounds=8, optimizer="sgd", reach=0.05), some(coarse(valid), slice(24))
    assert refiner(*pose).energies.total.mean() < 0.7 * refiner.energy(*pose).total.mean()
