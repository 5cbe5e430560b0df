"""The plugin that compares kernels on two devices tells what differs, and changes no results."""

import numpy as np
import warp as wp
from support.mirror import Mirror

from lgrasp.runtime.device import KERNEL_OPTIONS, start

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class Two:
    some: wp.array(dtype=float)
    more: wp.array(dtype=float)


@wp.kernel
def add(given: Two, sum_out: wp.array(dtype=float)):
    i = wp.tid()
    sum_out[i] = given.some[i] + given.more[i]


def test_launches_do_what_they_did():
    start()
    mirror, two = Mirror("cpu", package=__name__), Two()
    two.some = two.more = wp.array(np.arange(5.0), dtype=float, device="cpu")
    made = wp.zeros(5, dtype=float, device="cpu")
    mirror.launch(add, 5, [two], [made], device="cpu")
    np.testing.assert_array_equal(made.numpy(), 2 * np.arange(5))
    assert mirror.found[f"{__name__}:add sum_out"] == [0, 4]  # the first was and is 0
    assert list(mirror.lines()) == ["2 arguments of 1 kernels compared"]


def test_what_differs_is_told():
    mirror, one, other = Mirror("cpu"), np.ones(100, np.float32), np.ones(100, np.float32)
    other[:3] = 1.1, np.nan, 0.0
    mirror.compare("kernel near", 0 * one, one, one + 1e-6)
    mirror.compare("kernel far", 0 * one, one, other)
    mirror.compare("kernel words", np.zeros(4, int), np.arange(4), np.arange(4)[::-1])
    assert list(mirror.lines()) == [
        " 100.0% of         4 kernel words",
        "   3.0% of       100 kernel far",
        "3 arguments of 1 kernels compared",
    ]
