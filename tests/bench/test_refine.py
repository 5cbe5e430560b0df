"""Plans that lift their object, in each simulator."""

import pytest

from lgrasp.bench.refine import bench_hands, refine_page
from lgrasp.engine.cache import Cache

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")


@pytest.mark.parametrize("engine", ["mujoco", "physx"])
def test_plans_are_valid_by_the_lift_of_the_paper(engine, cache_root):
    if engine == "physx":
        pytest.importorskip("sapien", reason="PhysX is not installed (extra physx)", exc_type=ImportError)
    found = bench_hands(["barrett"], ["box"], 2, engine=engine, noises=(), device="cpu", cache=Cache(cache_root))
    assert found["protocol"] == ("dipgrasp" if engine == "mujoco" else "physx_dipgrasp")
    plans = found["hands"]["barrett"]["planning"]["mesh"]
    for one in plans.values():
        assert one["valid"] <= one["planned"] <= one["starts"] == 2
    assert plans["best"]["valid"] > 0
    (head,) = refine_page(found).head
    assert head.endswith(f"valid by {found['protocol']}")
