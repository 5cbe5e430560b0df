"""What training reads beside rows by number: streams, splits in files, normalisation."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader
from typer.testing import CliRunner

from lgrasp.dataset.normalisation import Normalisation
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.split import Groups, Split, draw_split, make_split
from lgrasp.dataset.torch_dataset import GraspDataset
from lgrasp.dataset.torch_stream import GraspIterableDataset
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import ConfigError, ShardError
from lgrasp.geometry.poses import pose_matrix
from lgrasp_cli.dataset import app

SIZES = (420, 40, 60, 0, 30, 20)
ROWS = sum(SIZES)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, make_shard):
    """Shards of six meshes, each row with a candidate of its own."""
    folder, first = tmp_path_factory.mktemp("stream"), 0
    for number, rows in enumerate(SIZES):
        shard = make_shard(rows, shard_index=number)
        objects = [replace(o, sha256=f"{number:064x}") for o in shard.objects]
        candidate = np.arange(first, first + rows, dtype=np.uint64)
        made = replace(shard, objects=objects, grasps=replace(shard.grasps, candidate=candidate))
        write_shard(folder / f"{number}.h5", made)
        first += rows
    return folder


def numbers(rows) -> list[int]:
    return torch.cat([row["candidate"].reshape(-1) for row in rows]).tolist()


@pytest.mark.parametrize("buffer", [0, 100])
def test_every_row_once_an_epoch(folder, buffer):
    data = GraspIterableDataset(folder, columns=["candidate", "q"], buffer=buffer, seed=3)
    found = numbers(data)
    assert len(data) == ROWS
    assert sorted(found) == list(range(ROWS))
    assert (found == list(range(ROWS))) == (buffer == 0)
    assert numbers(data) == found
    data.set_epoch(1)
    assert (numbers(data) == found) == (buffer == 0)
    with pytest.raises(ValueError, match="name at least one"):
        GraspIterableDataset(folder, columns=[])
    assert (numbers(GraspIterableDataset(folder, columns=["candidate"], buffer=buffer, seed=4)) == found) == (
        not buffer
    )


def test_rows_are_those_of_the_map_style(folder):
    data, every = GraspIterableDataset(folder, buffer=100), GraspDataset(folder)
    row = next(iter(data))
    assert row.keys() == every[0].keys()
    for name, values in every[int(row["candidate"])].items():
        assert torch.equal(row[name].nan_to_num(7), values.nan_to_num(7)), name


def test_ranks_and_workers_share_the_rows(folder):
    parts = []
    for rank in range(3):
        data = GraspIterableDataset(folder, columns=["candidate"], buffer=50, batch=64, rank=rank, ranks=3)
        loader = DataLoader(data, batch_size=None, num_workers=2, multiprocessing_context="fork")
        parts.append(numbers(loader))
        assert len(data) == -(-len(parts[-1]) // 64)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    assert sorted(itertools.chain(*parts)) == list(range(ROWS))
    with pytest.raises(ValueError, match="rank=3"):
        GraspIterableDataset(folder, rank=3, ranks=3)


def test_batches(folder):
    data = GraspIterableDataset(folder, columns=["candidate"], batch=64, buffer=500)
    sizes = [len(batch["candidate"]) for batch in data]
    assert set(sizes[:-1]) == {64}
    assert (len(sizes), sum(sizes)) == (len(data), ROWS)


@pytest.mark.parametrize("by", ["object", "pose"])
def test_splits_in_files(folder, tmp_path, by):
    """Parts are disjoint and whole, in both data sets; no object (or pose) is in two."""
    made = make_split(folder, by=by, seed=1)
    made.write(tmp_path / "split.json")
    assert Split.read(tmp_path / "split.json") == made
    seen = {}
    for part, told in made.parts.items():
        data = GraspDataset(folder, columns=["candidate", "object_index"], split=tmp_path / "split.json", part=part)
        rows = data.__getitems__(range(len(data)))
        seen[part] = set(numbers(rows))
        assert len(data) == told.rows == len(seen[part])
        assert set(numbers(GraspIterableDataset(folder, columns=["candidate"], split=made, part=part))) == seen[part]
        held = {data.objects[int(row["object_index"][0])][1] for row in rows}
        assert by == "pose" or held <= set(told.sha256)
    assert sorted(set().union(*seen.values())) == list(range(ROWS))
    assert sum(map(len, seen.values())) == ROWS
    parts = GraspDataset(folder, columns=["candidate"]).split(by=by, seed=1)
    assert [set(part.indices) for part in parts] == list(seen.values())


def test_split_by_hand(folder, tmp_path, make_shard):
    shard = make_shard(10)
    write_shard(tmp_path / "other.h5", replace(shard, hand=replace(shard.hand, name="other", sha256="b" * 64)))
    made = make_split([folder, tmp_path], by="hand", shares={"train": 0.9, "test": 0.1})
    assert [part.rows for part in made.parts.values()] in ([ROWS, 10], [10, ROWS])
    part = next(name for name, told in made.parts.items() if told.names == ("other",))
    assert len(GraspDataset([folder, tmp_path], split=made, part=part)) == 10


def test_the_order_of_shards_is_nothing_to_a_split():
    """Nor is the first object of a set that was held at once."""
    one = Groups([("b", "a"), ("c", "b")], np.array([3, 4]), {name: name for name in "abc"})
    other = Groups([("d",)], np.array([5]), {"d": "d"})
    turned = Groups([("b", "c"), ("a", "b")], np.array([4, 3]), one.names)
    for seed in range(20):
        made = [
            draw_split(shards, by="object", shares={"train": 0.5, "test": 0.5}, seed=seed)
            for shards in ((one, other), (other, one), (turned, other), (other, turned))
        ]
        assert all(split == made[0] for split in made)


def test_a_part_is_named_once(folder, tmp_path):
    asked = ["split", str(folder), "--by", "pose", "-o", str(tmp_path / "s.json"), "--shares", "train=0.8,train=0.2"]
    result = CliRunner().invoke(app, asked)
    assert isinstance(result.exception, ConfigError)
    assert "part 'train' is named twice" in str(result.exception)


@pytest.mark.parametrize("shares", ["train=0.5,test=0.6", "train=0.8,val=0.1,test=0.1", "train=4,test=2"])
def test_shares_of_a_split(folder, tmp_path, shares):
    """Up to 1, or whole numbers."""
    asked = ["split", str(folder), "--by", "object", "-o", str(tmp_path / "split.json"), "--shares", shares]
    result = CliRunner().invoke(app, asked)
    refused = shares.endswith("0.6")
    assert isinstance(result.exception, ConfigError) == refused == ("their sum is 1.1;" in str(result.exception))
    assert (tmp_path / "split.json").exists() != refused


def test_split_errors(folder, tmp_path, make_shard):
    made = make_split(folder, by="object")
    with pytest.raises(ConfigError, match="no part 'dev'"):
        GraspDataset(folder, split=made, part="dev")
    for kind in (GraspDataset, GraspIterableDataset, Normalisation.of):
        with pytest.raises(ConfigError, match="part 'test' is of no split"):
            kind(folder, part="test")
    write_shard(tmp_path / "new.h5", make_shard(3, seed=9))
    shard = read_shard(tmp_path / "new.h5")
    objects = [replace(o, sha256="e" * 64) for o in shard.objects]
    write_shard(tmp_path / "new.h5", replace(shard, objects=objects))
    with pytest.raises(ShardError, match="object 'cup' is in no part"):
        GraspDataset(tmp_path / "new.h5", split=made)
    (tmp_path / "x.json").write_text("{}")
    (tmp_path / "deep.json").write_text("[" * 100_000)
    for name, words in (("none", "No such file"), ("x", "split writes one"), ("deep", "split writes one")):
        with pytest.raises(ConfigError, match=words):
            GraspDataset(folder, split=tmp_path / f"{name}.json")
    with pytest.raises(ShardError, match="no row is in part 'train'"):
        GraspDataset(folder / "3.h5", split=made)


def test_normalisation(folder, tmp_path):
    """Means and deviations of the hand in the object's frame are those of NumPy; vectors come back as rows."""
    split = make_split(folder, by="pose", shares={"train": 0.5, "test": 0.5})
    made = Normalisation.of(folder, split=split)
    made.write(tmp_path / "n.json")
    again = Normalisation.read(tmp_path / "n.json")
    assert again == made
    data = GraspDataset(folder, columns=["q", "object_pose"], split=split)
    (rows,) = DataLoader(data, batch_size=len(data))
    T = np.linalg.inv(pose_matrix(rows["object_pose"][:, 0].numpy().astype(float)))
    vectors = np.concatenate([T[:, :3, 3], T[:, :3, 0], T[:, :3, 1], rows["q"].numpy()], 1)
    assert made.rows == len(data)
    np.testing.assert_allclose(made.mean, vectors.mean(0), atol=1e-5)
    np.testing.assert_allclose(made.std, vectors.std(0), atol=1e-5)
    assert made.names[9:] == tuple(data.hand().joint_names)
    x = again.encode(rows["object_pose"], rows["q"])
    assert x.mean(0).abs().max() < 1e-4
    pose, q = again.decode(x)
    np.testing.assert_allclose(pose, rows["object_pose"][:, 0], atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(q, rows["q"], atol=1e-5, rtol=1e-5)


def test_commands(folder, tmp_path, monkeypatch):
    from typer.testing import CliRunner

    from lgrasp_cli.dataset import app

    monkeypatch.chdir(tmp_path)
    run = CliRunner().invoke
    done = run(app, ["split", str(folder), "--by", "object", "--shares", "train=0.5,test=0.5"])
    assert (done.exit_code, "split.json" in done.stdout) == (0, True)
    done = run(app, ["normalisation", str(folder), "--split", "split.json", "--json", "-"])
    assert json.loads(done.stdout)["rows"] == Split.read("split.json").parts["train"].rows
    assert Normalisation.read("normalisation.json").rows == json.loads(done.stdout)["rows"]
    with pytest.raises(ConfigError, match="PART=SHARE"):
        run(app, ["split", str(folder), "--by", "pose", "--shares", "train"], catch_exceptions=False)
