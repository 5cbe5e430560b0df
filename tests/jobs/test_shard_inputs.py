"""Hand and object of a shard: made from the shard alone, whatever lies under their names where it is read."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.places import ASSETS

from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.run import run
from lgrasp.engine.run import run as generate
from lgrasp.errors import HandError, ShardError
from lgrasp.grasp.records import Shard
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.hands import hand_source
from lgrasp.jobs.refine.plan import PlanJob
from lgrasp.jobs.refine.shards import RefineJob
from lgrasp.jobs.shard_inputs import hand_of_shard, named_hand, named_object, object_of_shard
from lgrasp.planning.params import PlanParams

REAL = ASSETS / "hands" / "allegro"


@pytest.fixture(scope="module")
def made(swift, cache_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A shard of an Allegro that no longer exists: its URDF, named by its path, differed from the shipped one."""
    folder = tmp_path_factory.mktemp("own")
    shutil.copytree(hand_source("allegro").urdf.parent, folder / "hand")
    (folder / "hand" / "hand.yaml").unlink()
    (urdf,) = (folder / "hand").glob("*.urdf")
    urdf.write_text(urdf.read_text().replace("</robot>", "  <!-- mine -->\n</robot>"))
    given = {"pipeline": swift, "out": folder / "out", "device": "cpu", "workers": 1, "cache": Cache(cache_root)}
    path = generate(GenerateJob(hand=str(urdf), object="mug", rows=12, batch=128, **given)).paths[0]
    shutil.rmtree(folder / "hand")
    return path


def without_rules(shard: Shard, **hand) -> Shard:
    """As written before shards held the rules of their hand."""
    config = {name: value for name, value in shard.header.config.items() if name != "hand_rules"}
    return replace(shard, header=replace(shard.header, config=config), hand=replace(shard.hand, **hand))


def same(one, other) -> None:
    for name, values in one.to_arrays().items():
        np.testing.assert_array_equal(values, other.to_arrays()[name], err_msg=name)


def test_a_named_hand_must_be_that_of_the_shard(made: Path, cache_root: Path, tmp_path: Path):
    job = RefineJob(shards=(made,), out=tmp_path / "out", hand="allegro", device="cpu", cache=Cache(cache_root))
    with pytest.raises(HandError, match="leave --hand out, the hand is in the shard"):
        run(job)


def test_the_hand_is_the_one_that_was_generated_with(job: Callable[..., GenerateJob], cache_root: Path):
    outcome = generate(job(rows=5))
    shard = read_shard(outcome.paths[0])
    source, model = hand_of_shard(Cache(cache_root, pytest.fail), shard.hand, shard.header.config)
    assert source.spec == hand_source("allegro").spec.model_copy(update={"approximation": ""})
    same(model, outcome.job.inputs.hand.model)


@pytest.mark.skipif(not REAL.is_dir(), reason="the real Allegro with mesh fingertips is not here")
def test_meshes_come_from_the_shard(swift, cache_root: Path, tmp_path: Path):
    """Its URDF names them as package://...; the folder is gone and nothing is in the cache."""
    shutil.copytree(REAL, tmp_path / "before")
    given = {"pipeline": swift, "out": tmp_path / "a", "cache": Cache(cache_root)}
    outcome = generate(GenerateJob(hand=str(tmp_path / "before/allegro.urdf"), object="sphere", rows=5, **given))
    shutil.move(tmp_path / "before", tmp_path / "after")
    shard = read_shard(outcome.paths[0])
    assert shard.hand.meshes
    given["out"] = tmp_path / "b"
    moved = generate(GenerateJob(hand=str(tmp_path / "after/allegro.urdf"), object="sphere", rows=5, **given))
    assert moved.job.inputs.hits["hand"]  # no path is part of what the cache holds
    assert read_shard(moved.paths[0]).hand.meshes == shard.hand.meshes
    shutil.rmtree(tmp_path / "after")
    fresh = Cache(tmp_path / "cache", pytest.fail)
    _, model = hand_of_shard(fresh, shard.hand, shard.header.config)
    same(model, outcome.job.inputs.hand.model)
    lost = replace(shard.hand, meshes=dict(list(shard.hand.meshes.items())[1:]))
    with pytest.raises(ShardError, match="is not in the shard"):
        hand_of_shard(fresh, lost, shard.header.config)
    (name, data), *_ = shard.hand.meshes.items()
    outside = replace(
        shard.hand,
        urdf=shard.hand.urdf.replace(name, "../../m.stl"),
        meshes={**shard.hand.meshes, "../../m.stl": data},
    )
    with pytest.raises(ShardError, match="outside the hand's folder"):
        hand_of_shard(fresh, outside, shard.header.config)


def test_older_shards_take_the_rules_of_a_known_hand_and_say_so(made: Path, cache_root: Path):
    said: list[str] = []
    old = without_rules(read_shard(made), name="mine")
    source, model = hand_of_shard(Cache(cache_root, said.append), old.hand, old.header.config)
    assert source.spec.contact == hand_source("allegro").spec.contact
    assert model.name == "mine"
    (line,) = said
    assert "does not hold the rules of its hand 'mine'" in line
    assert "known hand 'allegro'" in line


def test_older_shards_of_an_installed_hand_need_no_words(job: Callable[..., GenerateJob], cache_root: Path):
    old = without_rules(read_shard(generate(job(rows=5)).paths[0]))
    source, _ = hand_of_shard(Cache(cache_root, pytest.fail), old.hand, old.header.config)
    assert source.spec == hand_source("allegro").spec


def test_plans_take_hand_and_object_from_a_shard(made: Path, cache_root: Path, tmp_path: Path):
    cache = Cache(cache_root, pytest.fail)
    few: dict[str, Any] = {"starts": 2, "params": PlanParams(rolls=8, finalists=2), "device": "cpu"}
    (path,) = run(PlanJob(hand=str(made), object=str(made), out=tmp_path / "plans", cache=cache, **few)).paths
    plan, shard = read_shard(path), read_shard(made)
    assert plan.hand == replace(shard.hand, joint_lower=plan.hand.joint_lower, joint_upper=plan.hand.joint_upper)
    np.testing.assert_array_equal(plan.objects[0].faces, shard.objects[0].faces)
    np.testing.assert_allclose(plan.objects[0].vertices, shard.objects[0].vertices, atol=1e-7)


def test_an_object_is_cached(made: Path, tmp_path: Path):
    cache, (record,) = Cache(tmp_path / "cache", pytest.fail), read_shard(made).objects
    whole = object_of_shard(cache, record)
    same(object_of_shard(cache, record), whole)
    assert len(cache.entries()) == 1


def test_a_shard_of_no_single_object_is_no_object(made: Path, cache_root: Path, tmp_path: Path):
    shard = read_shard(made)
    two = [shard.objects[0], replace(shard.objects[0], id="zwei")]
    write_shard(tmp_path / "two.h5", replace(shard, objects=two))
    with pytest.raises(ShardError, match="holds the objects mug, zwei"):
        named_object(Cache(cache_root), str(tmp_path / "two.h5"), 1.0)
    with pytest.raises(ShardError, match="in metres"):
        named_object(Cache(cache_root), str(made), 0.001)


def test_rules_are_plain_json(made: Path, cache_root: Path):
    config = read_shard(made).header.config
    assert json.loads(config["hand_rules"])["name"] == "allegro"
    assert named_hand(Cache(cache_root, pytest.fail), str(made))[1].sha256 == read_shard(made).hand.sha256
