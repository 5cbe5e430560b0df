"""The terms of the energy against their formulas."""

import math

import numpy as np
import pytest
import torch

from lgrasp.refine.energy import barrier, limit_energy, wrench_energy
from lgrasp.refine.params import LocalSearch

P = LocalSearch()


def published(u: float) -> float:
    """The barrier of incremental potential contact, in units of its margin."""
    return -((u - 1) ** 2) * math.log(u) if u < 1 else 0.0


@pytest.mark.parametrize("u", [0.1, 0.15, 0.4, 0.8, 0.999, 1.0, 1.7])
def test_barrier_outside(u):
    assert float(barrier(torch.tensor(u, dtype=torch.float64))) == pytest.approx(published(u), abs=1e-12)


def test_barrier_pushes_out_harder_the_deeper():
    u = torch.linspace(-3, 1, 200, dtype=torch.float64, requires_grad=True)
    value = barrier(u)
    (slope,) = torch.autograd.grad(value.sum(), u)
    assert (value.diff() < 0).all()
    assert (slope[:-1] < 0).all()
    assert (slope.diff() > 0).all()


def test_barrier_is_smooth_where_its_parts_meet():
    for at in (0.1, 1.0):
        u = torch.tensor([at - 1e-7, at + 1e-7], dtype=torch.float64, requires_grad=True)
        (slope,) = torch.autograd.grad(barrier(u).sum(), u, create_graph=True)
        (bend,) = torch.autograd.grad(slope.sum(), u)
        assert slope[0].item() == pytest.approx(slope[1].item(), abs=1e-4)
        assert bend[0].item() == pytest.approx(bend[1].item(), abs=1e-3)


def test_wrench_of_opposed_contacts_is_nothing():
    x = torch.tensor([[[0.03, 0.0, 0.01], [-0.03, 0.0, 0.01]]])
    c = torch.tensor([[[-1.0, 0, 0], [1.0, 0, 0]]])
    assert wrench_energy(x, c, torch.zeros(3), 0.05, P).item() == pytest.approx(0, abs=1e-9)


def test_wrench_of_any_contacts():
    rng = np.random.default_rng(1)
    x, c = rng.normal(size=(5, 4, 3)) * 0.04, rng.normal(size=(5, 4, 3))
    com, radius = rng.normal(size=3) * 0.01, 0.06
    wrench = np.concatenate([c, np.cross((x - com) / radius, c)], -1).sum(1)
    found = wrench_energy(torch.as_tensor(x), torch.as_tensor(c), torch.as_tensor(com), radius, P)
    np.testing.assert_allclose(found.numpy(), P.force * (wrench**2).sum(1) / 16, rtol=1e-12)


def test_limits_count_near_the_ends_only_and_grow_outside():
    lower, upper = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    q = torch.tensor([[0.5], [0.84], [0.9], [1.0], [1.1]], dtype=torch.float64)
    found = limit_energy(q, lower, upper, P)
    assert found[0] == found[1] == 0
    assert 0 < found[2] < found[3] < found[4]
    assert found[2].item() == pytest.approx(P.limits * published(0.1 / 0.15))
