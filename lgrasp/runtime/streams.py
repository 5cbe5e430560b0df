"""Random numbers by row: a function of the row's seed and the step alone, the same on every device and in any batch."""

import math

import torch

_GAMMA, _A, _B = -7046029254386353131, -4658895280553007687, -7723592293110705685  # splitmix64


def _mixed(z: torch.Tensor) -> torch.Tensor:
    """The finaliser of splitmix64; int64 products wrap around, shifts are made logical."""
    z = (z ^ ((z >> 30) & 0x3FFFFFFFF)) * _A
    z = (z ^ ((z >> 27) & 0x1FFFFFFFFF)) * _B
    return z ^ ((z >> 31) & 0x1FFFFFFFF)


def uniforms(seed: torch.Tensor, step: int | torch.Tensor, count: int) -> torch.Tensor:
    """Uniform numbers in (0, 1), (N, count) f64.

    Args:
        seed: of each row, (N,) int64. step: any number below 2^32, or (); each has numbers of its own.
    """
    place = torch.arange(count, device=seed.device) + (step << 20)
    key = _mixed(seed * _GAMMA + 1)[:, None] + place * _GAMMA
    bits = (_mixed(key) >> 11) & ((1 << 53) - 1)
    return (bits.to(torch.float64) + 0.5) * 2.0**-53


def normals(seed: torch.Tensor, step: int | torch.Tensor, count: int) -> torch.Tensor:
    """Standard normal numbers, (N, count) f64; see :func:`uniforms`, whose numbers of that step they use."""
    half = -(-count // 2)
    u = uniforms(seed, step, 2 * half)
    r, a = (-2 * u[:, :half].log()).sqrt(), 2 * math.pi * u[:, half:]
    return torch.cat([r * a.cos(), r * a.sin()], 1)[:, :count]
