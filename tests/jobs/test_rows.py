"""Rows on disk: frames, contacts and claims, read by others."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.places import QUICK

from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.run import run as generate
from lgrasp.engine.shard import Execution, make_shard
from lgrasp.geometry.poses import pose_matrix
from lgrasp.jobs.generate import GenerateJob
from lgrasp.judge.run import judge
from lgrasp.object.find import find_object


@pytest.mark.parametrize("name", ["mug", "box"])
def test_strictly_valid(run, name):
    """An independent judge finds every row valid and agrees with the stored numbers."""
    (path,) = run(object=name, rows=30, shard_rows=30).paths
    report = judge(path, mesh=find_object(name))
    assert report.rows == 30
    assert report.valid_share == 1.0, report
    assert report.repeats.near == 0
    bounds = {
        "fswo": 2e-3,
        "gswo (stored normals)": 0.014,  # the filter's bound and this stay below the strict one
        "gap [mm]": 0.15,
        "penetration [mm]": 1.1,  # both sample surfaces; the bound of the filter and this stay below the strict one
        "normal_error [deg]": 10.0,  # stored: of the facet hit; judged: the best of those that meet there
        "self_penetration [mm]": 0.5,
    }
    for key, bound in bounds.items():
        assert report.metrics[key]["max"] < bound, key


@pytest.fixture(scope="module")
def rows(small_job, swift, inputs, tmp_path_factory):
    changes = {"rows": 40, "shard_rows": 40, "out": tmp_path_factory.mktemp("rows")}
    (path,) = generate(GenerateJob(**small_job | changes)).paths
    return path, read_shard(path), make_shard(swift, inputs, 0, 40, Execution()).grasps


def test_user_frame(rows, inputs):
    """Poses and contacts of the shard are those of the table, seen from the user's frame."""
    path, shard, table = rows
    assert validate_shard(path) == []
    obj, got = inputs.object.model, shard.grasps
    T = pose_matrix(got.object_pose[:, 0].astype(float))
    R = Rotation.from_quat(table.pose[:, 3:])
    np.testing.assert_allclose(T[:, :3, :3], R.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(T[:, :3, :3] @ obj.center + T[:, :3, 3], table.pose[:, :3], atol=1e-6)
    assert (got.object_pose[:, 0, 3] >= 0).all()
    np.testing.assert_array_equal(got.q, table.q)
    width = got.contact_links.shape[2]
    for i in range(len(table)):
        used = table.contact_links[i] >= 0
        points = got.contact_points[i, 0][: used.sum()]
        before = R[i].apply(table.contact_points[i][used]) + table.pose[i, :3]
        np.testing.assert_allclose(points @ T[i, :3, :3].T + T[i, :3, 3], before, atol=1e-6)
        np.testing.assert_array_equal(got.contact_links[i, 0][: used.sum()], table.contact_links[i][used])
    assert width == (table.contact_links >= 0).sum(1).max()
    np.testing.assert_array_equal(got.metrics["contacts"], (table.contact_links >= 0).sum(1))


def test_contacts_lie_on_object_and_links(rows):
    """With the user's mesh, and the links as yourdfpy poses them."""
    yourdfpy = pytest.importorskip("yourdfpy")
    path, shard, _ = rows
    mesh = trimesh.load_mesh(find_object("mug"))
    urdf = path.with_suffix(".urdf")
    urdf.write_text(shard.hand.urdf)
    robot = yourdfpy.URDF.load(str(urdf), build_scene_graph=True, load_meshes=False)
    links = {
        link.name: [(c.origin if c.origin is not None else np.eye(4), c.geometry) for c in link.collisions]
        for link in robot.robot.links
    }
    got = shard.grasps
    T = pose_matrix(got.object_pose[:, 0].astype(float))
    for i in range(len(got)):
        robot.update_cfg(dict(zip(shard.hand.joint_names, got.q[i].astype(float), strict=True)))
        used = got.contact_links[i, 0] >= 0
        points = got.contact_points[i, 0][used].astype(float)
        _, distance, _ = trimesh.proximity.closest_point(mesh, points)
        assert distance.max() < 2e-5
        for p, link in zip(points, got.contact_links[i, 0][used], strict=True):
            name = shard.hand.link_names[link]
            at = np.linalg.inv(robot.get_transform(name, shard.hand.base_link)) @ T[i] @ [*p, 1.0]
            gaps = [_solid_distance(g, (np.linalg.inv(o) @ at)[:3]) for o, g in links[name]]
            assert abs(min(gaps)) < 1.5e-3, (i, name)


def _solid_distance(geometry, p: np.ndarray) -> float:
    """Signed distance [m] of a point to a box, sphere or cylinder in its own frame."""
    if geometry.box is not None:
        d = np.abs(p) - np.asarray(geometry.box.size) / 2
        return float(np.linalg.norm(np.maximum(d, 0)) + min(d.max(), 0))
    if geometry.sphere is not None:
        return float(np.linalg.norm(p) - geometry.sphere.radius)
    c = geometry.cylinder
    d = np.array([np.hypot(p[0], p[1]) - c.radius, abs(p[2]) - c.length / 2])
    return float(np.linalg.norm(np.maximum(d, 0)) + min(d.max(), 0))


def test_scaled_object(run, tmp_path):
    """A mesh in other units, scaled, gives the poses of the original."""
    mesh = trimesh.load_mesh(find_object("tiny"))
    mesh.apply_scale(4.0)
    path = tmp_path / "tiny.obj"
    mesh.export(path)
    asked = {"rows": 20, "pipeline": load_pipeline(QUICK)}
    (small,) = run(object="tiny", out=tmp_path / "a", **asked).paths
    (large,) = run(object=str(path), scale=0.25, out=tmp_path / "b", **asked).paths
    a, b = read_shard(small), read_shard(large)
    np.testing.assert_allclose(a.objects[0].vertices, b.objects[0].vertices, atol=1e-6)
    assert b.objects[0].scale == 0.25
    assert len(b.grasps) == 20


def test_header(rows, swift):
    _, shard, table = rows
    header = shard.header
    assert (header.pipeline, header.seed, header.shard_index) == ("swift", 0, 0)
    assert header.config["pipeline"] == swift.describe()
    assert len(header.config["run_key"]) == 64
    assert shard.statistics["place_tried"] == shard.statistics["candidates"]
    assert shard.statistics["filter_kept"] >= len(table)
    assert shard.statistics["exhausted"] == 0
    np.testing.assert_array_equal(shard.grasps.candidate, table.index.astype(np.uint64))
