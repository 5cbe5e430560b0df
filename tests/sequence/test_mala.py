"""The Langevin sampler: known distributions, on flat and on curved coordinates."""

import numpy as np
import pytest
import torch

from lgrasp.geometry.rotations import so3_exp
from lgrasp.sequence.optimiser.anneal import Langevin, run_chain


def sample(evaluate, moved, x: torch.Tensor, scale, T: float, steps: int) -> torch.Tensor:
    """States after ``steps`` steps of one chain per row."""
    seed = torch.arange(len(x))
    scale = torch.as_tensor(scale, dtype=x.dtype)
    chains = Langevin(evaluate, moved, seed, lambda _: scale, lambda _: T)
    counts = torch.ones(len(x), 2, dtype=torch.int64)
    return run_chain(chains, x, counts, seed, torch.ones(steps, 1, dtype=x.dtype), switch=0.5).x


def test_samples_a_known_gaussian():
    """Mean and covariance to 3 %, with steps so long that without the proposal ratio they would be off."""
    mean = torch.tensor([1.0, -2.0, 4.0], dtype=torch.float64)
    A = torch.tensor([[1.0, 0.0, 0.0], [0.3, 1.2, 0.0], [-0.4, 0.5, 2.0]], dtype=torch.float64)
    T = 0.5
    covariance = A @ A.T
    precision = T * torch.linalg.inv(covariance)  # exp(-E / T) is the Gaussian

    def evaluate(x, contact, weights):
        d = x - mean
        return 0.5 * ((d @ precision) * d).sum(1, keepdim=True), d @ precision

    x = sample(evaluate, torch.add, torch.zeros(20_000, 3, dtype=torch.float64), [0.2, 1.0, 3.0], T, 100)
    spread = covariance.diagonal().sqrt()
    np.testing.assert_allclose(((x.mean(0) - mean) / spread).numpy(), 0, atol=0.03)
    np.testing.assert_allclose(x.T.cov().diagonal() / covariance.diagonal(), 1, atol=0.03)
    np.testing.assert_allclose(
        x.T.cov() / (spread[:, None] * spread), covariance / (spread[:, None] * spread), atol=0.03
    )


def test_long_steps_are_made_up_for():
    """E = x^2 / 2 at T = 1 with step 1: all steps accepted, the variance would be 2."""

    def evaluate(x, contact, weights):
        return 0.5 * x * x, x

    x = sample(evaluate, torch.add, torch.zeros(40_000, 1, dtype=torch.float64), [1.0], 1.0, 60)
    assert x.var().item() == pytest.approx(1.0, abs=0.03)


def test_coordinates_without_scale_stay():
    def evaluate(x, contact, weights):
        return 0.5 * (x * x).sum(1, keepdim=True), x

    start = torch.full((5000, 2), 3.0, dtype=torch.float64)
    x = sample(evaluate, torch.add, start, [0.5, 0.0], 1.0, 80)
    assert (x[:, 1] == 3.0).all()
    assert x[:, 0].mean().item() == pytest.approx(0, abs=0.05)


def test_samples_rotations_about_their_own_axes():
    """E = -k trace(R): the angle a has density exp(k (1 + 2 cos a)) (1 - cos a)."""
    k = 1.5

    def evaluate(x, contact, weights):
        R = x.reshape(-1, 3, 3)
        # d trace(R exp[w]) / dw
        slope = torch.stack([R[:, 1, 2] - R[:, 2, 1], R[:, 2, 0] - R[:, 0, 2], R[:, 0, 1] - R[:, 1, 0]], 1)
        return -k * torch.einsum("nii->n", R)[:, None], -k * slope

    def moved(x, motion):
        return (x.reshape(-1, 3, 3) @ so3_exp(motion)).reshape(-1, 9)

    start = torch.eye(3, dtype=torch.float64).reshape(1, 9).expand(20_000, 9)
    x = sample(evaluate, moved, start, [0.4, 0.4, 0.4], 1.0, 80)
    cosine = (torch.einsum("nii->n", x.reshape(-1, 3, 3)).numpy() - 1) / 2
    a = np.linspace(0, np.pi, 20_001)
    density = np.exp(k * (1 + 2 * np.cos(a))) * (1 - np.cos(a))
    density /= np.trapezoid(density, a)
    mean = np.trapezoid(density * np.cos(a), a)
    variance = np.trapezoid(density * (np.cos(a) - mean) ** 2, a)
    assert cosine.mean() == pytest.approx(mean, rel=0.03)
    assert cosine.var() == pytest.approx(variance, rel=0.03)
