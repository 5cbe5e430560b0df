"""A compiled module is found again, whatever the process that looks for it has compiled before."""

import sys

import warp as wp

from lgrasp.runtime.kernels import import_all
from lgrasp.runtime.unrolled import unrolled


@unrolled
@wp.func
def triangle(n: wp.int32):
    total = int(0)
    for i in range(wp.static(4)):
        if wp.static(i) < n:
            total += i
    return total


@wp.kernel(module="unique")
def once(n: wp.int32, total_out: wp.array(dtype=wp.int32)):
    total_out[0] = triangle(n)


@wp.kernel(module="unique")
def twice(n: wp.int32, total_out: wp.array(dtype=wp.int32)):
    total_out[0] = 2 * triangle(n)


def test_what_was_compiled_before_does_not_change_a_hash():
    before = twice.module.hash_module()
    total = wp.zeros(1, dtype=wp.int32, device="cpu")
    wp.launch(once, 1, [3], [total], device="cpu")
    assert total.numpy() == [3]
    assert twice.module.hash_module() == before


def test_every_loop_over_static_values_is_known_as_such():
    import_all()
    for name in [name for name in sys.modules if name.startswith("lgrasp.")]:
        assert not wp.get_module(name).has_unresolved_static_expressions, f"{name}: @unrolled is missing"
