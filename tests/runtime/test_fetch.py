"""Copies of device arrays on the host."""

import ast

import numpy as np
import pytest
import warp as wp
from support.sources import modules_with, parse

from lgrasp.runtime.fetch import fetch, wait_for


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


def test_device_arrays_come_to_the_host_in_one_place():
    """Warp's own ``numpy()`` changes the stream of the device for all threads: only tensors on the CPU have it here."""
    found = []
    for path in modules_with(".numpy("):
        if path.name != "fetch.py":
            calls = [x for x in ast.walk(parse(path)) if isinstance(x, ast.Call)]
            asked = [x.func.value for x in calls if isinstance(x.func, ast.Attribute) and x.func.attr == "numpy"]
            found += [
                f"{path.name}:{x.lineno}"
                for x in asked
                if not (isinstance(x, ast.Call) and isinstance(x.func, ast.Attribute) and x.func.attr == "cpu")
            ]
    assert not found


def test_waits_while_another_thread_captures_a_graph(monkeypatch):
    """Warp refuses to wait then; every other error is passed on."""
    answers = [RuntimeError("Cannot synchronize event while graph capture is active"), None]
    asked = []

    def synchronize(event):
        asked.append(event)
        if answer := answers.pop(0):
            raise answer

    monkeypatch.setattr("lgrasp.runtime.fetch.wp.synchronize_event", synchronize)
    wait_for("event")
    assert asked == ["event"] * 2
    answers.append(RuntimeError("an illegal memory access was encountered"))
    with pytest.raises(RuntimeError, match="illegal"):
        wait_for("event")
