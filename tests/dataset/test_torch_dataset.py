import multiprocessing
import pickle
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.torch_dataset import GraspDataset
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import ShardError


@pytest.fixture
def folder(tmp_path, make_shard):
    write_shard(tmp_path / "a.h5", make_shard(5, objects=2, contacts=2))
    write_shard(tmp_path / "b.h5", make_shard(0, objects=1, shard_index=1))
    shard = make_shard(4100, objects=3, columns=3, contacts=4, shard_index=2)
    write_shard(tmp_path / "c.h5", replace(shard, objects=[replace(o, scale=0.1) for o in shard.objects]))
    return tmp_path


def test_rows_of_all_shards(folder):
    data = GraspDataset(folder)
    assert len(data) == 4105
    assert data.objects == sorted(data.objects)
    assert len(data.objects) == 5
    a, c = read_shard(folder / "a.h5").grasps, read_shard(folder / "c.h5").grasps
    np.testing.assert_array_equal(data[2]["q"], a.q[2])
    np.testing.assert_array_equal(data[5 + 4098]["q"], c.q[4098])
    np.testing.assert_array_equal(data[-1]["physics/success"], c.physics["success"][-1])
    assert data[0]["contact_points"].shape == (3, 4, 3)
    assert (data[0]["contact_links"][2:] == -1).all()
    assert data[0]["candidate"].dtype == torch.int64
    assert data[5]["object_pose"].dtype == torch.float32
    for index, rows, scale in ((1, a, 0.05), (5, c, 0.1)):
        row = index if index < 5 else index - 5
        number = int(data[index]["object_index"][0])
        assert data.objects[number][2] == scale
        assert data.object(number).id == ["cup", "mug é", "sphere"][rows.object_index[row, 0]]
    assert data.hand().name == "toy"
    with pytest.raises(IndexError):
        data[4105]


def test_rows_that_fail_a_bound_are_left_out(tmp_path, make_sequence):
    """Parents are counted among those that are left."""
    shard = make_sequence((4, 5, 3))
    rows = shard.grasps
    childless = ~np.isin(np.arange(12), rows.sequence.parent)
    valid = (~childless | (np.arange(12) % 2 == 0)).astype("f4")
    metrics = {**rows.metrics, "valid": valid}
    write_shard(tmp_path / "a.h5", replace(shard, grasps=replace(rows, metrics=metrics)))
    data, every = GraspDataset(tmp_path), GraspDataset(tmp_path, negatives=True)
    taken = np.flatnonzero(valid)
    assert (len(data), len(every)) == (len(taken), 12)
    for place, row in enumerate(taken):
        assert torch.equal(data[place]["q"], every[int(row)]["q"])
        old, new = int(rows.sequence.parent[row]), int(data[place]["sequence/parent"])
        assert new == -1 if old == -1 else taken[new] == old


def test_shards_with_and_without_negatives(tmp_path, make_shard):
    """All rows of a shard without negatives are valid: the labels of the others are theirs, too."""
    shard, codes = make_shard(4), np.array([0, 2, 0, 1], "f4")
    metrics = shard.grasps.metrics | {"valid": (codes == 0).astype("f4"), "failed_bound": codes}
    units = shard.grasps.metric_units | {"valid": "", "failed_bound": "code: 0 none, 1 max_gap, 2 max_gswo"}
    failing = replace(shard, grasps=replace(shard.grasps, metrics=metrics, metric_units=units))
    for names in (("a", "b"), ("b", "a")):
        folder = tmp_path / "".join(names)
        for name, one in zip(names, (shard, failing), strict=True):
            write_shard(folder / f"{name}.h5", one)
        data = GraspDataset(folder, columns=["metrics/valid", "metrics/failed_bound"], negatives=True)
        assert data.failed_bounds == ("none", "max_gap", "max_gswo")
        rows = [(int(row["metrics/valid"]), int(row["metrics/failed_bound"])) for row in data]
        bare, labelled = [(1, 0)] * 4, [(1, 0), (0, 2), (1, 0), (0, 1)]
        assert rows == (bare + labelled if names == ("a", "b") else labelled + bare)
        assert "metrics/valid" in GraspDataset(folder, negatives=True)[0]
        assert len(GraspDataset(folder)) == 6


def test_numbers_of_either_byte_order(tmp_path, make_shard):
    write_shard(tmp_path / "a.h5", make_shard(5))
    q = read_shard(tmp_path / "a.h5").grasps.q
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        told = dict(file["grasps/q"].attrs)
        del file["grasps/q"]
        file.create_dataset("grasps/q", data=q.astype(">f4")).attrs.update(told)
    np.testing.assert_array_equal(GraspDataset(tmp_path)[2]["q"], q[2])


def test_default_collate_with_two_workers(folder):
    data = GraspDataset(folder, columns=["q", "candidate", "contact_points", "metrics/gap"])
    data[0]  # the parent has read before the workers start
    context = multiprocessing.get_context("fork")
    loader = DataLoader(data, batch_size=1000, shuffle=True, num_workers=2, multiprocessing_context=context)
    batches = list(loader)
    assert batches[0]["contact_points"].shape == (1000, 3, 4, 3)
    got = torch.cat([batch["candidate"] for batch in batches]).sort().values
    expected = torch.cat([torch.arange(5), 2000 + torch.arange(4100)])
    assert torch.equal(got, expected)


def test_small_cache_and_pickle(folder):
    data = GraspDataset(folder, cache_bytes=1)
    again = pickle.loads(pickle.dumps(data))
    for index in (0, 4104, 3, 4100):
        assert torch.equal(data[index]["q"], again[index]["q"])
    data[0]["q"].fill_(9)
    assert not (data[0]["q"] == 9).any()


def test_errors(folder, make_shard):
    with pytest.raises(ShardError, match="no column 'nope'"):
        GraspDataset(folder, columns=["nope"])
    shard = make_shard(1)
    write_shard(folder / "d.h5", replace(shard, hand=replace(shard.hand, sha256="d" * 64)))
    with pytest.raises(ShardError, match=r"d\.h5: another hand"):
        GraspDataset(folder)


def sides(data, parts, key):
    """What ``key`` tells of the rows of each part, as sets."""
    assert sorted(i for part in parts for i in part.indices) == list(range(len(data)))
    return [{key(data[i]) for i in part.indices} for part in parts]


def test_split_by_object(tmp_path, make_shard):
    for number in range(6):
        shard = make_shard(20 + number, objects=1, shard_index=number)
        objects = [replace(o, sha256=f"{number // 2:064x}", scale=1.0 + number) for o in shard.objects]
        write_shard(tmp_path / f"{number}.h5", replace(shard, objects=objects))
    data = GraspDataset(tmp_path)
    assert len(data.objects) == 6  # three meshes, two scales of each
    parts = data.split(by="object")
    found = sides(data, parts, lambda row: data.objects[int(row["object_index"][0])][1])
    assert [len(s) for s in found] == [1, 1, 1]
    assert len(set().union(*found)) == 3
    assert [p.indices for p in data.split(by="object")] == [p.indices for p in parts]
    assert any(data.split(by="object", seed=s)[0].indices != parts[0].indices for s in range(1, 9))
    with pytest.raises(ShardError, match="3 object"):
        data.split(by="object", shares=[1, 1, 1, 1])
    with pytest.raises(ValueError, match="by='row'"):
        data.split(by="row")
    with pytest.raises(ValueError, match="shares are positive"):
        data.split(by="object", shares=(0.5, 0.0))


def test_split_keeps_objects_held_at_once_together(folder):
    data = GraspDataset(folder)
    with pytest.raises(ShardError, match="cannot be split"):
        data.split(by="object", shares=(0.7, 0.2, 0.1))


def test_split_by_pose(tmp_path, make_shard):
    shard = make_shard(1000, objects=1)
    pose = np.repeat(np.arange(250, dtype=np.uint64), 4)
    candidate = pose + (np.arange(1000, dtype=np.uint64) % np.uint64(4) << np.uint64(32))  # four passes over a pose
    write_shard(tmp_path / "a.h5", replace(shard, grasps=replace(shard.grasps, candidate=candidate)))
    data = GraspDataset(tmp_path)
    parts = data.split(by="pose")
    found = sides(data, parts, lambda row: int(row["candidate"]) & 0xFFFFFFFF)
    assert sum(map(len, found)) == 250
    assert [len(p) for p in parts] == pytest.approx([800, 100, 100], abs=4)
