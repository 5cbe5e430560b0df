import hashlib
from dataclasses import replace

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.fresh import loaded

from lgrasp.dataset.reader import ShardReader, read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import ShardError
from lgrasp.geometry.poses import pose_matrix


@settings(max_examples=8, deadline=None)
@given(
    n=st.sampled_from([0, 1, 2, 7]),
    joints=st.integers(1, 6),
    links=st.integers(1, 5),
    objects=st.integers(1, 3),
    columns=st.integers(1, 4),
    contacts=st.integers(0, 5),
    seed=st.integers(0, 99),
)
def test_what_is_written_is_read(tmp_path_factory, make_shard, same_rows, n, seed, objects, **shape):
    path = tmp_path_factory.mktemp("roundtrip") / "shard.h5"
    shard = make_shard(n, objects=objects, seed=seed, **shape)
    write_shard(path, shard)
    back = read_shard(path)
    same_rows(shard.grasps, back.grasps)
    assert validate_shard(path) == []
    assert back.header == shard.header
    assert back.statistics == shard.statistics
    assert back.hand.urdf == shard.hand.urdf
    assert back.hand.meshes == shard.hand.meshes
    assert list(back.hand.link_names) == shard.hand.link_names
    assert [o.id for o in back.objects] == [o.id for o in shard.objects]
    np.testing.assert_array_equal(back.objects[0].vertices, shard.objects[0].vertices)


def test_same_shard_same_bytes(tmp_path, make_shard):
    for name in ("a.h5", "b.h5"):
        write_shard(tmp_path / name, make_shard(9, objects=2))
    a, b = (hashlib.sha256((tmp_path / name).read_bytes()).digest() for name in ("a.h5", "b.h5"))
    assert a == b


def test_rows_are_compressed_with_checksums_in_chunks(tmp_path, make_shard):
    write_shard(tmp_path / "s.h5", make_shard(5000))
    with h5py.File(tmp_path / "s.h5") as file:
        q = file["grasps/q"]
        assert (q.chunks, q.compression, q.compression_opts, q.shuffle, q.fletcher32) == (
            (4096, 4),
            "gzip",
            1,
            True,
            True,
        )
        assert file["grasps/metrics/gap"].attrs["unit"] == "m"
        assert sorted(file["objects"]) == ["cup"]


def test_lazy_rows_and_blocks(tmp_path, make_shard, same_rows):
    shard = make_shard(5000)
    write_shard(tmp_path / "s.h5", shard)
    with ShardReader(tmp_path / "s.h5") as reader:
        assert len(reader) == 5000
        np.testing.assert_array_equal(reader.column("q", 4090, 4100), shard.grasps.q[4090:4100])
        np.testing.assert_array_equal(reader.rows(10, 12).metrics["gap"], shard.grasps.metrics["gap"][10:12])
        assert reader.object("cup").name == "cup.obj"
        with pytest.raises(ShardError, match="no dataset 'nope'; it has q, "):
            reader.column("nope")
        with pytest.raises(ShardError, match="no object 'nope'; it has cup"):
            reader.object("nope")
        assert [(first, len(rows)) for first, rows in reader.blocks()] == [(0, 4096), (4096, 904)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"q": np.zeros((4, 4))}, "axis 0 has length"),
        ({"q": np.full((5, 4), np.nan)}, "q: not finite"),
        ({"q": np.full((5, 4), 3.0)}, "outside the joint limits"),
        ({"contact_links": np.full((5, 1, 3), 70000)}, "do not fit int16"),
        ({"physics_protocols": {}}, "names no protocol"),
        ({"object_index": np.full((5, 1), 1)}, "object_index: must be -1 to 0"),
    ],
)
def test_writer_refuses_what_does_not_conform(tmp_path, make_shard, change, message):
    shard = make_shard(5)
    with pytest.raises(ShardError, match=message):
        write_shard(tmp_path / "s.h5", replace(shard, grasps=replace(shard.grasps, **change)))
    assert list(tmp_path.iterdir()) == []


def test_writer_refuses_unsorted_objects(tmp_path, make_shard):
    shard = make_shard(5, objects=2)
    with pytest.raises(ShardError, match="sorted"):
        write_shard(tmp_path / "s.h5", replace(shard, objects=shard.objects[::-1]))


def test_pose_matrix():
    half = np.sqrt(0.5)
    T = pose_matrix(np.array([[1, 2, 3, half, 0, 0, half], [0, 0, 0, 1, 0, 0, 0]]))  # 90 deg about z; identity
    np.testing.assert_allclose(T[0], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-15)
    np.testing.assert_array_equal(T[1], np.eye(4))
    assert np.isnan(pose_matrix(np.full(7, np.nan))[:3]).any()


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_pose_matrix_is_a_rotation(quaternion):
    R = pose_matrix(np.array([0, 0, 0, *quaternion]))[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)


def test_import_needs_no_torch():
    assert loaded("import lgrasp.dataset.merge, lgrasp.dataset.validate, lgrasp_cli.dataset", ["torch"]) == []
    assert loaded("import lgrasp_cli.dataset") == []


def test_point_clouds_have_normals(tmp_path, make_shard):
    shard = make_shard(3)
    (mesh,) = shard.objects
    n = np.random.default_rng(0).normal(size=mesh.vertices.shape).astype(np.float32)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    cloud = replace(mesh, faces=np.zeros((0, 3), np.int32), normals=n)
    write_shard(tmp_path / "cloud.h5", replace(shard, objects=[cloud]))
    assert validate_shard(tmp_path / "cloud.h5") == []
    np.testing.assert_array_equal(read_shard(tmp_path / "cloud.h5").objects[0].normals, n)
    write_shard(tmp_path / "mesh.h5", shard)
    assert read_shard(tmp_path / "mesh.h5").objects[0].normals is None
    for bad, words in ((2 * n, "not of unit length"), (np.nan * n, "not of unit length"), (n[1:], "vertices")):
        with pytest.raises(ShardError, match=words):
            write_shard(tmp_path / "bad.h5", replace(shard, objects=[replace(cloud, normals=bad)]))
    assert not (tmp_path / "bad.h5").exists()
