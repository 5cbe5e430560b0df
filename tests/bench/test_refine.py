"""Plans that lift their object, in MuJoCo."""

import pytest

from lgrasp.bench.refine import bench_hands, refine_page
from lgrasp.engine.cache import Cache
from lgrasp.planning.params import PlanParams

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")


def test_plans_are_valid_by_the_lift_of_the_paper(cache_root):
    how = {"params": PlanParams(rolls=8, finalists=2), "noises": (), "device": "cpu", "cache": Cache(cache_root)}
    found = bench_hands(["barrett"], ["box"], 2, engine="mujoco", **how)
    assert found["protocol"] == "dipgrasp"
    plans = found["hands"]["barrett"]["planning"]["mesh"]
    for one in plans.values():
        assert one["valid"] <= one["planned"] <= one["starts"] == 2
    assert plans["best"]["valid"] > 0
    (head,) = refine_page(found).head
    assert head.endswith(f"valid by {found['protocol']}")
