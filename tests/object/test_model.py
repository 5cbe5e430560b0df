"""The whole preprocessing: frames, invariances, masks on real shapes, storage."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from lgrasp.geometry.clusters import CLUSTER_SIZE
from lgrasp.object.find import find_object
from lgrasp.object.model import ObjectModel
from lgrasp.object.params import ObjectParams
from lgrasp.object.preprocess import preprocess_object
from lgrasp.object.sdf import sample_sdf


def assert_same(a: ObjectModel, b: ObjectModel) -> None:
    one, two = a.to_arrays(), b.to_arrays()
    assert one.keys() == two.keys()
    for key in one:
        assert one[key].dtype == two[key].dtype, key
        assert one[key].tobytes() == two[key].tobytes(), key


@pytest.fixture(scope="module")
def mug(fast) -> ObjectModel:
    return preprocess_object(find_object("mug"), params=fast)


def test_arrays(mug, fast):
    n, m, k = len(mug.contact_points), fast.obstacle_count, fast.obstacle_count // CLUSTER_SIZE
    shapes = {
        "center": (3,),
        "com": (3,),
        "extents": (3,),
        "contact_points": (n, 3),
        "contact_normals": (n, 3),
        "obstacle_points": (m, 3),
        "obstacle_normals": (m, 3),
        "cluster_center": (k, 3),
        "cluster_radius": (k,),
        "sdf_origin": (3,),
    }
    for name, shape in shapes.items():
        value = getattr(mug, name)
        assert value.shape == shape, name
        assert value.dtype == np.float32, name
        assert np.isfinite(value).all(), name
    assert mug.faces.dtype == np.int32
    assert mug.sdf.dtype == np.float32
    assert mug.sdf.size <= fast.sdf_cells
    assert mug.watertight
    assert mug.notes == []
    assert np.linalg.norm(mug.contact_normals, axis=1) == pytest.approx(1.0, abs=1e-6)
    offset = mug.obstacle_points.reshape(k, CLUSTER_SIZE, 3) - mug.cluster_center[:, None]
    assert (np.linalg.norm(offset, axis=-1) <= mug.cluster_radius[:, None]).all()


def test_points_lie_on_the_surface(mug):
    mesh = trimesh.Trimesh(mug.vertices - mug.center, mug.faces, process=False)
    for points in (mug.contact_points, mug.obstacle_points):
        assert (
            trimesh.proximity.closest_point(mesh, points)[1].max() < 5e-5
        )  # trimesh is no more exact on mm-sized faces
    sdf = mug.grid
    assert (sample_sdf(sdf, mug.contact_points + 0.002 * mug.contact_normals) > 0.0).all()
    assert mug.com == pytest.approx(mesh.center_mass, abs=1e-6)


def test_no_spot_is_far_from_an_obstacle_point():
    model = preprocess_object(find_object("mug"))
    mesh = trimesh.Trimesh(model.vertices - model.center, model.faces, process=False)
    spots = trimesh.sample.sample_surface(mesh, 20000, seed=5)[0]
    assert KDTree(model.obstacle_points).query(spots)[0].max() < 0.004


def test_mug_keeps_its_inner_wall_and_handle_but_not_its_corners(mug):
    p, n = mug.contact_points + mug.center, mug.contact_normals
    radial = np.linalg.norm(mug.contact_points[:, :2] - axis_of(mug), axis=1)
    inner = (np.abs(radial - 0.036) < 5e-4) & (p[:, 2] > 0.02) & (p[:, 2] < 0.09)
    assert inner.sum() > 50
    assert (radial > 0.05).sum() > 20
    toward = np.einsum("nd,nd->n", mug.contact_points[:, :2] - axis_of(mug), n[:, :2])
    corner = (toward < 0.0) & (radial < 0.0365) & (p[:, 2] > 0.009) & (p[:, 2] < 0.0105)
    assert not corner.any()


def axis_of(mug: ObjectModel) -> np.ndarray:
    """The mug's axis in its internal frame: the body is 80 mm wide, the handle sticks out along +x."""
    return np.array([0.040 - 0.5 * mug.extents[0], 0.0])


def test_edges_carry_no_contact_but_have_obstacle_points(fast):
    model = preprocess_object(find_object("box"), params=fast)
    half = 0.5 * model.extents
    to_edge = np.sort(half - np.abs(model.contact_points), axis=1)[:, 1]
    assert to_edge.min() >= fast.sharp_radius - 1e-6
    corners = half * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    assert KDTree(model.obstacle_points).query(corners)[0].max() < 0.003


def test_same_input_same_bytes(mug, fast):
    assert_same(mug, preprocess_object(find_object("mug"), params=fast))


def test_seed_changes_the_samples(mug, fast):
    other = preprocess_object(find_object("mug"), params=fast.model_copy(update={"seed": 1}))
    assert other.sdf.tobytes() == mug.sdf.tobytes()
    assert other.contact_points.tobytes() != mug.contact_points.tobytes()


@pytest.mark.parametrize("shift", [(1.0, -2.0, 4.0), (0.1, 0.03, -0.07)])
def test_translation_moves_only_the_center(shift):
    params = ObjectParams(contact_count=256, obstacle_count=256, sdf_cells=48**3)
    mesh = trimesh.load_mesh(find_object("screwdriver"))
    a = preprocess_object(mesh, params=params)
    b = preprocess_object(mesh.copy().apply_translation(shift), params=params)
    assert b.center - a.center == pytest.approx(shift, abs=1e-6)
    assert b.com == pytest.approx(a.com, abs=1e-6)
    assert b.sdf.shape == a.sdf.shape
    assert np.abs(b.sdf - a.sdf).max() < 1e-6
    assert len(b.contact_points) == pytest.approx(len(a.contact_points), abs=3)
    assert KDTree(a.obstacle_points).query(b.obstacle_points)[0].max() < 0.01


def test_scale_gives_the_same_object(tmp_path, mug, fast):
    mesh = trimesh.load_mesh(find_object("mug"))
    mesh.apply_scale(1000.0)
    model = preprocess_object(mesh, scale=0.001, params=fast)
    assert model.scale == 0.001
    assert model.center == pytest.approx(mug.center, abs=1e-7)
    assert np.abs(model.sdf - mug.sdf).max() < 1e-6


def test_round_trip(tmp_path, mug, fast):
    np.savez(tmp_path / "mug.npz", **mug.to_arrays())
    with np.load(tmp_path / "mug.npz", allow_pickle=False) as arrays:
        back = ObjectModel.from_arrays(arrays)
    assert_same(back, mug)
    assert back.sha256 == mug.sha256
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    noted = preprocess_object(trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False), params=fast)
    again = ObjectModel.from_arrays(noted.to_arrays())
    assert again.notes == noted.notes != []
    assert isinstance(again.sdf_cell, float)
    assert isinstance(again.watertight, bool)
    assert all(v.dtype != object for v in noted.to_arrays().values())


def test_open_mesh_is_accepted(fast):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    cut = trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] < 0.02], process=False)
    model = preprocess_object(cut, params=fast)
    assert not model.watertight
    assert model.com[2] != 0.0
    inside = (model.sdf < 0.0).sum() * model.sdf_cell**3
    assert inside == pytest.approx(ball.volume, rel=0.25)
    assert len(model.contact_points) > 100
    assert np.einsum("nd,nd->n", model.contact_points + model.center, model.contact_normals).min() > 0.0


def test_masks_relax_rather_than_leave_nothing(fast):
    rng = np.random.default_rng(0)
    rough = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    rough.vertices += 0.0008 * rng.normal(size=rough.vertices.shape)
    model = preprocess_object(rough, params=fast)
    assert len(model.contact_points) >= 0.1 * fast.contact_count
    assert any("few smooth contact points" in n for n in model.notes)


@pytest.mark.parametrize("name", ["apple", "mug", "spoon"])
def test_scanned_meshes(real_mesh, fast, name):
    path = real_mesh(name)
    model = preprocess_object(path, params=fast)
    mesh = trimesh.load_mesh(path)
    assert model.watertight
    assert len(model.contact_points) > 50
    assert (model.sdf < 0.0).sum() * model.sdf_cell**3 == pytest.approx(mesh.volume, rel=0.1)
