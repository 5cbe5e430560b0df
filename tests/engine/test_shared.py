"""Hands with joints that move several fingers: every row has one of the listed values, and fingers agree on it."""

from itertools import product

import numpy as np
import pytest

from lgrasp.dataset.reader import read_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.hand.find import find_hand
from lgrasp.jobs.generate import GenerateJob, generate
from lgrasp.judge.run import judge


@pytest.fixture
def cache(cache_root) -> Cache:
    return Cache(cache_root)


@pytest.mark.parametrize("name", ["barrett", "schunk_svh"])
def test_rows_take_the_listed_values_and_are_valid(name, cache, tmp_path):
    pipeline = load_pipeline("swift")
    pipeline = pipeline.model_copy(update={"field": pipeline.field.model_copy(update={"records": 40_000})})
    outcome = generate(GenerateJob(hand=name, object="sphere", rows=60, pipeline=pipeline, out=tmp_path, cache=cache))
    assert outcome.rows == 60
    shard = read_shard(outcome.paths[0])
    names = list(shard.hand.joint_names)
    shared = find_hand(name).spec.shared
    columns = [names.index(joint) for joint in shared]
    listed = {tuple(np.float32(v) for v in values) for values in product(*shared.values())}
    for q in (shard.grasps.q, shard.grasps.q_pregrasp, shard.grasps.q_squeeze):
        taken = {tuple(row) for row in q[:, columns]}
        assert taken <= listed
        assert len(taken) >= min(4, len(listed))
    # the judge poses every link from the one joint vector: fingers that disagreed would miss their contacts
    assert judge(outcome.paths).valid.all()


def test_couplings_of_the_known_hand_fill_gaps(tmp_path):
    """A copy of a URDF that lost its mimic tags is driven like the hand."""
    folder = find_hand("barrett").urdf
    text = "\n".join(line for line in folder.read_text().splitlines() if "<mimic" not in line)
    bare = tmp_path / "bare.urdf"
    bare.write_text(text)
    source = find_hand(str(bare))
    assert source.name == "barrett"
    assert "couplings" in source.note
    coupling = source.spec.mimic["finger_2_prox_joint"]
    assert (coupling.joint, coupling.multiplier) == ("finger_1_prox_joint", -1.0)
    assert len(source.spec.mimic) == 4


def test_joints_that_only_the_rules_couple_are_in_the_shard(cache, tmp_path):
    """Whoever poses the URDF of the shard by its joints gets the hand that grasped."""
    text = "\n".join(line for line in find_hand("barrett").urdf.read_text().splitlines() if "<mimic" not in line)
    bare = tmp_path / "bare.urdf"
    bare.write_text(text)
    pipeline = load_pipeline("swift")
    pipeline = pipeline.model_copy(update={"field": pipeline.field.model_copy(update={"records": 40_000})})
    outcome = generate(
        GenerateJob(hand=str(bare), object="sphere", rows=40, pipeline=pipeline, out=tmp_path / "out", cache=cache)
    )
    assert outcome.rows == 40
    shard = read_shard(outcome.paths[0])
    names = list(shard.hand.joint_names)
    assert len(names) == len(set(names)) == 8
    assert names[:4] == [n for n in names if n not in find_hand(str(bare)).spec.mimic]
    q = shard.grasps.q
    for joint, coupling in find_hand(str(bare)).spec.mimic.items():
        wanted = coupling.multiplier * q[:, names.index(coupling.joint)] + coupling.offset
        np.testing.assert_allclose(q[:, names.index(joint)], wanted, atol=1e-6)
    assert judge(outcome.paths).valid.all()
