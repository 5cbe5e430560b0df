"""Random numbers of rows: distribution, independence of the batch."""

import numpy as np
import torch
from scipy import stats

from lgrasp.runtime.streams import normals, uniforms


def test_uniform_normal_and_uncorrelated():
    seed = torch.arange(2000)
    u = np.stack([uniforms(seed, k, 40).numpy() for k in range(5)])  # (steps, rows, numbers)
    assert 0 < u.min() < u.max() < 1
    assert stats.kstest(u.ravel(), "uniform").pvalue > 1e-3
    n = np.stack([normals(seed, k, 41).numpy() for k in range(5)])
    assert stats.kstest(n.ravel(), "norm").pvalue > 1e-3
    for x in (u - 0.5, n):
        for a, b in ((x[1:], x[:-1]), (x[:, 1:], x[:, :-1]), (x[:, :, 1:], x[:, :, :-1])):
            assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 4 / np.sqrt(a.size)


def test_first_numbers_of_splitmix64():
    """Row 0, step 0: the generator from the state mixed(1), by Python's integers."""
    mask = (1 << 64) - 1

    def mixed(z: int) -> int:
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
        return z ^ (z >> 31)

    key = mixed(1)
    expected = [((mixed((key + i * 0x9E3779B97F4A7C15) & mask) >> 11) + 0.5) * 2.0**-53 for i in range(6)]
    assert uniforms(torch.zeros(1, dtype=torch.int64), 0, 6)[0].tolist() == expected


def test_rows_steps_and_counts_do_not_matter_to_one_another():
    seed = torch.tensor([5, 123456789012, 7, 5])
    u = uniforms(seed, 3, 10)
    assert torch.equal(u[0], u[3])
    assert torch.equal(uniforms(seed[1:2], 3, 4)[0], u[1, :4])
    numbers = torch.cat([uniforms(seed[:3], k, 10).ravel() for k in range(4)])
    assert len(numbers.unique()) == 120
