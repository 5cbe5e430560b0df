import json
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest
from support.shards import write_manifest

from lgrasp.dataset.files import find_shards
from lgrasp.dataset.info import describe, pooled
from lgrasp.dataset.merge import merge_shards
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import ShardError


@pytest.fixture(scope="module")
def made(tmp_path_factory, make_shard):
    folder = tmp_path_factory.mktemp("made")
    for index, (n, shape) in enumerate([(3, {"contacts": 2}), (0, {}), (4100, {"columns": 3, "contacts": 4})]):
        shard = make_shard(n, objects=2, shard_index=index, **({"columns": 2} | shape))
        write_shard(folder / f"{9 - index}.h5", shard)  # file names run against the shard order
    return folder


@pytest.fixture
def folder(tmp_path, made):
    return shutil.copytree(made, tmp_path / "run")


def test_rows_follow_in_shard_order(folder, tmp_path):
    out = tmp_path / "all.h5"
    assert merge_shards(folder, out) == 4103
    assert validate_shard(out) == []
    merged, parts = read_shard(out), [read_shard(folder / f"{i}.h5") for i in (9, 8, 7)]
    np.testing.assert_array_equal(merged.grasps.candidate, np.concatenate([p.grasps.candidate for p in parts]))
    np.testing.assert_array_equal(merged.grasps.q, np.concatenate([p.grasps.q for p in parts]))
    np.testing.assert_array_equal(merged.grasps.contact_links[:3, :2, :2], parts[0].grasps.contact_links)
    assert (merged.grasps.contact_links[:3, 2:] == -1).all()
    assert np.isnan(merged.grasps.contact_forces[:3, :, 2:]).all()
    np.testing.assert_array_equal(merged.grasps.object_pose[3:], parts[2].grasps.object_pose)
    assert merged.statistics == {"survivors/place": 300, "seconds/place": 0.75, "device": "cpu"}
    assert merged.header.shard_index == -1
    assert [part["shard_index"] for part in merged.header.merged_from] == [0, 1, 2]
    assert merged.grasps.metric_units == parts[0].grasps.metric_units


def test_merging_again_gives_the_same_bytes_and_may_live_in_the_folder(folder, tmp_path):
    merge_shards(folder, tmp_path / "all.h5")
    merge_shards(folder, folder / "all.h5")
    merge_shards(folder, folder / "all.h5")
    assert (folder / "all.h5").read_bytes() == (tmp_path / "all.h5").read_bytes()


def test_merge_in_two_steps_equals_one(folder, tmp_path, same_rows):
    merge_shards([folder / "9.h5", folder / "8.h5"], tmp_path / "part.h5")
    merge_shards([tmp_path / "part.h5", folder / "7.h5"], tmp_path / "two.h5")
    merge_shards(folder, tmp_path / "one.h5")
    one, two = read_shard(tmp_path / "one.h5"), read_shard(tmp_path / "two.h5")
    same_rows(one.grasps, two.grasps)
    assert one.header == two.header
    with pytest.raises(ShardError, match=r"shard 0 is already in .*leave one out"):
        merge_shards([tmp_path / "part.h5", folder / "9.h5"], tmp_path / "x.h5")


def test_out_must_not_be_an_input(folder):
    with pytest.raises(ShardError, match="must not be one of"):
        merge_shards([folder / "9.h5", folder / "8.h5"], folder / "9.h5")


def test_manifest(folder, tmp_path, make_shard):
    manifest = write_manifest(folder)
    (run,) = json.loads(manifest.read_text())["runs"]
    assert [entry["rows"] for entry in run["shards"]] == [4100, 0, 3]
    assert merge_shards(folder, tmp_path / "all.h5") == 4103
    shutil.copy(folder / "9.h5", folder / "new.h5")
    with pytest.raises(ShardError, match=r"1 of the shards there are not listed, first new\.h5"):
        merge_shards(folder, tmp_path / "x.h5", manifest=manifest)
    (folder / "new.h5").unlink()
    data = bytearray((folder / "9.h5").read_bytes())
    data[-1] ^= 1
    (folder / "9.h5").write_bytes(data)
    with pytest.raises(ShardError, match=r"9\.h5: SHA-256 is"):
        merge_shards(folder, tmp_path / "x.h5")
    (folder / "9.h5").unlink()
    with pytest.raises(ShardError, match=r"1 of 3 shards are missing, first 9\.h5"):
        merge_shards([folder / "8.h5", folder / "7.h5"], tmp_path / "x.h5", manifest=manifest)
    manifest.write_text("[]")
    with pytest.raises(ShardError, match="not a manifest of shards"):
        merge_shards(folder, tmp_path / "x.h5")
    with pytest.raises(ShardError, match="no manifest there"):
        merge_shards(folder, tmp_path / "x.h5", manifest=tmp_path / "none.json")
    assert not (tmp_path / "x.h5").exists()


@pytest.mark.parametrize(
    ("what", "how"),
    [
        ("hand", "hand: other here, toy there, files: cccccccccccc here, "),
        ("objects", "scale 0.07 here, .* there"),
        ("config", "search.steps: 9 here, none there"),
        ("seed", "seed: 8 here, 7 there"),
        ("metrics and physics", r"physics/.*: none here, .* there"),
        ("metric units", "gap: mm here, m there"),
    ],
)
def test_what_does_not_belong_together_is_refused(tmp_path, make_shard, what, how):
    a, b = make_shard(2, objects=2), make_shard(2, objects=2, shard_index=1)
    rows = b.grasps
    b = {
        "hand": replace(b, hand=replace(b.hand, name="other", sha256="c" * 64)),
        "objects": replace(b, objects=[b.objects[0], replace(b.objects[1], scale=0.07)]),
        "config": replace(
            b, header=replace(b.header, config={**b.header.config, "run_key": "0", "search": {"steps": 9}})
        ),
        "seed": replace(b, header=replace(b.header, seed=8)),
        "metrics and physics": replace(b, grasps=replace(rows, physics={}, physics_protocols={})),
        "metric units": replace(b, grasps=replace(rows, metric_units={"gap": "mm"})),
    }[what]
    for name, shard in (("a.h5", a), ("b.h5", b)):
        write_shard(tmp_path / name, shard)
    with pytest.raises(ShardError, match=rf"b\.h5: {what} differs from .*a\.h5 \(.*{how}.*\); merge only"):
        merge_shards(tmp_path, tmp_path / "out.h5")


def test_damaged_rows_are_not_merged(folder, tmp_path):
    with h5py.File(folder / "9.h5", "r+") as file:
        file["grasps/q"][1, 1] = np.nan
    with pytest.raises(ShardError, match=r"9\.h5: grasps/q: not finite"):
        merge_shards(folder, tmp_path / "x.h5")
    assert list(tmp_path.glob("x*")) == []


def test_describe_and_find(folder, tmp_path):
    seven, _, nine = describe(folder)
    assert (seven["rows"], nine["rows"], nine["objects"], nine["hand"]) == (4100, 3, ["cup", "mug é"], "toy")
    assert nine["columns"]["contact_points"] == [3, 2, 2, 3]
    gap = read_shard(folder / "9.h5").grasps.metrics["gap"]
    assert nine["metrics"]["gap"] == {
        "unit": "m",
        "finite": 3,
        "min": gap.min(),
        "mean": pytest.approx(gap.mean()),
        "max": gap.max(),
    }
    assert describe(folder / "8.h5")[0]["metrics"]["gap"]["mean"] is None
    together = np.concatenate([read_shard(path).grasps.metrics["gap"] for path in find_shards(folder)])
    ends = {"min": together.min(), "mean": pytest.approx(together.mean(dtype=float)), "max": together.max()}
    assert pooled(describe(folder))["gap", "m"] == {"finite": len(together), **ends}
    json.dumps([seven, nine])
    with pytest.raises(ShardError, match="no such file or folder"):
        find_shards([folder, tmp_path / "none"])
    with pytest.raises(ShardError, match="no shard"):
        find_shards(tmp_path)
