"""Copies of device arrays on the host."""

import numpy as np
import pytest
import warp as wp

from lgrasp.runtime.fetch import fetch


@pytest.mark.parametrize("n", [0, 1, 1000])
def test_equals_numpy_and_stands_by_itself(device, n):
    random = np.random.default_rng(0)
    a = wp.array(random.normal(size=(n, 7)).astype(np.float32), dtype=wp.transform, device=device)
    b = wp.array(random.integers(0, 9, (n, 3)).astype(np.int32), dtype=wp.int32, device=device)
    c = wp.array(random.normal(size=(n, 2, 3)).astype(np.float32), dtype=wp.vec3, device=device)
    wanted = [x.numpy().copy() for x in (a, b, c)]
    found = fetch([a, b, c])
    fetch([c, b, a])  # the memory in between is used again
    for x in (a, b, c):
        x.zero_()
    for want, have in zip(wanted, found, strict=True):
        np.testing.assert_array_equal(have.reshape(want.shape), want)


def test_nothing():
    assert fetch([]) == []
