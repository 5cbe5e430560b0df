"""A hand with locked joints: a shard must be usable on the URDF as it is, without knowing hand.yaml."""

import numpy as np

from lgrasp.dataset.reader import read_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.run import run as generate
from lgrasp.field.params import FieldParams
from lgrasp.hand.find import find_hand
from lgrasp.jobs.generate import GenerateJob
from lgrasp.judge.run import judge


def test_locked_joints_are_in_the_shard(cache_root, tmp_path):
    name = "shadow"
    pipeline = load_pipeline("swift").model_copy(update={"field": FieldParams(records=20_000, index="bvh")})
    given = {"pipeline": pipeline, "out": tmp_path / "out", "cache": Cache(cache_root)}
    outcome = generate(GenerateJob(hand=name, object="sphere", rows=10, **given))
    shard = read_shard(outcome.paths[0])
    names = list(shard.hand.joint_names)
    locked = find_hand(name).spec.locked
    held = [j for j in locked if j in names]
    assert held, "no locked joint is in the shard"
    for joint in held:
        assert np.all(shard.grasps.q[:, names.index(joint)] == np.float32(locked[joint]))
    assert judge(outcome.paths).valid.mean() > 0.9
