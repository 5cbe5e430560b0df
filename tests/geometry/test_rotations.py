"""Rotations and rigid motions in torch against SciPy, the matrix exponential and finite differences."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lgrasp.geometry.rotations import (
    matrix_from_quaternion,
    matrix_from_sixd,
    quaternion_from_matrix,
    sixd_from_matrix,
    skew,
    so3_exp,
)

ANGLES = [0.0, 1e-12, 1e-5, 9.9e-3, 1.01e-2, 0.5, 3.0, np.pi - 1e-6]


def rotations(n: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(Rotation.random(n, random_state=seed).as_matrix())


def twists(angle: float, n: int = 8) -> torch.Tensor:
    rng = np.random.default_rng(1)
    w = rng.normal(size=(n, 3))
    return torch.from_numpy(np.hstack([rng.normal(size=(n, 3)), angle * w / np.linalg.norm(w, axis=1)[:, None]]))


def test_sixd_is_the_inverse_of_its_matrix_and_ignores_scale():
    R = rotations(50)
    d = sixd_from_matrix(R)
    torch.testing.assert_close(matrix_from_sixd(d), R)
    stretched = torch.cat([3 * d[:, :3], 0.2 * d[:, 3:] + 7 * d[:, :3]], 1)
    torch.testing.assert_close(matrix_from_sixd(stretched), R)


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(-2, 2), min_size=6, max_size=6))
def test_any_sixd_gives_a_rotation(values):
    d = torch.tensor(values, dtype=torch.float64)
    if torch.linalg.cross(d[:3], d[3:]).norm() < 1e-3:
        return
    R = matrix_from_sixd(d)
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), atol=1e-9, rtol=0)
    assert torch.linalg.det(R) == pytest.approx(1, abs=1e-9)


def test_quaternions_equal_scipy():
    R = torch.cat([rotations(200), torch.from_numpy(Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix())])
    q = quaternion_from_matrix(R)
    theirs = Rotation.from_matrix(R.numpy()).as_quat(canonical=True)
    assert (q[:, 3] >= 0).all()
    same = np.abs((q.numpy() * theirs).sum(1))  # a half turn has two quaternions with w = 0
    np.testing.assert_allclose(same, 1, atol=1e-12)
    torch.testing.assert_close(matrix_from_quaternion(q), R)


@pytest.mark.parametrize("angle", ANGLES)
def test_exponentials_equal_the_matrix_exponential(angle):
    w = twists(angle)[:, 3:]
    torch.testing.assert_close(so3_exp(w), torch.linalg.matrix_exp(skew(w)), atol=1e-12, rtol=0)


@pytest.mark.parametrize("angle", ANGLES[:-1])
def test_derivatives_equal_finite_differences(angle):
    w = twists(angle, 2)[:, 3:].clone().requires_grad_()
    assert torch.autograd.gradcheck(so3_exp, w, eps=1e-7, atol=1e-6)


def test_derivatives_of_conversions_equal_finite_differences():
    d = sixd_from_matrix(rotations(4)) * 1.3
    assert torch.autograd.gradcheck(matrix_from_sixd, d.requires_grad_())
    q = quaternion_from_matrix(rotations(4)).requires_grad_()
    assert torch.autograd.gradcheck(matrix_from_quaternion, q)
