"""Reading point clouds: what is accepted, what is repaired and told, what is refused."""

import numpy as np
import pytest
import trimesh

from lgrasp.cloud.read import read_cloud
from lgrasp.errors import CloudError

CENTRE = np.array([0.1, -0.2, 0.7])
RADIUS = 0.05


@pytest.fixture
def ball(tmp_path):
    """ball(name, **arrays): a sphere's points, its true normals and labels, and a file of some of them."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(2000, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points = CENTRE + RADIUS * normals

    def write(name="ball.npy", change=lambda p: p, **arrays):
        path = tmp_path / name
        if path.suffix == ".npz":
            np.savez(path, points=change(points.copy()), **arrays)
        elif path.suffix == ".xyz":
            np.savetxt(path, change(points.copy()))
        else:
            np.save(path, change(points.copy()))
        return path

    return write, points, normals


def write_ply(path, columns, *, binary):
    kind = "binary_little_endian" if binary else "ascii"
    types = {name: "int" if values.dtype.kind == "i" else "float" for name, values in columns.items()}
    lines = ["ply", f"format {kind} 1.0", f"element vertex {len(next(iter(columns.values())))}"]
    lines += [f"property {types[name]} {name}" for name in columns] + ["end_header", ""]
    rows = np.zeros(len(columns["x"]), [(n, "<i4" if types[n] == "int" else "<f4") for n in columns])
    for name, values in columns.items():
        rows[name] = values
    body = rows.tobytes() if binary else "\n".join(" ".join(map(str, row)) for row in rows.tolist()).encode()
    path.write_bytes("\n".join(lines).encode() + body)


@pytest.mark.parametrize("binary", [True, False])
def test_ply_with_normals_and_labels(tmp_path, ball, binary):
    _, points, normals = ball
    columns = dict(zip(("x", "y", "z", "nx", "ny", "nz"), np.hstack([points, normals]).T, strict=True))
    labels = (np.arange(len(points)) % 3).astype(np.int32)
    write_ply(tmp_path / "a.ply", columns | {"label": labels}, binary=binary)
    cloud = read_cloud(tmp_path / "a.ply", label=2)
    np.testing.assert_allclose(cloud.points, points, atol=1e-6)
    np.testing.assert_allclose(cloud.normals, normals, atol=1e-6)
    np.testing.assert_array_equal(cloud.target, labels == 2)
    assert not cloud.notes
    part = cloud.only(cloud.target)
    assert len(part) == int((labels == 2).sum())
    assert set(part.labels) == {2}


def test_ply_of_trimesh(tmp_path, ball):
    _, points, _ = ball
    trimesh.PointCloud(points).export(tmp_path / "a.ply")
    np.testing.assert_allclose(read_cloud(tmp_path / "a.ply").points, points, atol=1e-6)


@pytest.mark.parametrize("name", ["ball.npy", "ball.npz", "ball.xyz"])
def test_normals_are_estimated_and_face_the_camera(ball, name):
    write, points, normals = ball
    seen = np.einsum("nd,nd->n", normals, -points) > 0.2 * np.linalg.norm(points, axis=1)  # by a camera at the origin
    cloud = read_cloud(write(name, lambda p: p[seen]))
    assert np.einsum("nd,nd->n", cloud.normals, normals[seen]).min() > np.cos(np.radians(15.0))
    assert any("estimated" in note and "camera" in note for note in cloud.notes)


@pytest.mark.parametrize("viewpoint", [None, [0.5, 0.3, -0.2], CENTRE])
def test_normals_of_a_cloud_from_all_sides_are_turned_outwards(ball, viewpoint):
    write, _, normals = ball
    for change in (lambda p: p, lambda p: p - CENTRE):
        cloud = read_cloud(write("ball.npy", change), viewpoint=viewpoint)
        assert np.einsum("nd,nd->n", cloud.normals, normals).min() > np.cos(np.radians(15.0))
        assert any("estimated" in note and "outwards" in note for note in cloud.notes)


def test_given_normals_are_turned_to_the_viewpoint(ball):
    write, _, normals = ball
    up = normals[:, 2] > 0.1
    path = write("ball.npz", lambda p: p[up], normals=-normals[up])
    cloud = read_cloud(path, viewpoint=[0.1, -0.2, 5.0])
    np.testing.assert_allclose(cloud.normals, normals[up], atol=1e-6)
    assert any("turned" in note for note in cloud.notes)
    whole = read_cloud(write("ball.npz", normals=normals), viewpoint=[0.1, -0.2, 5.0])
    np.testing.assert_allclose(whole.normals, normals, atol=1e-6)


def test_colours_are_no_normals(ball):
    write, points, normals = ball
    colours = np.random.default_rng(0).integers(0, 256, points.shape)
    path = write("ball.xyz", lambda p: np.hstack([p, colours]))
    assert np.einsum("nd,nd->n", read_cloud(path).normals, normals).min() > np.cos(np.radians(15.0))
    path.write_text(path.read_text().replace(" ", ","))
    np.testing.assert_allclose(read_cloud(path).points, points, atol=1e-6)
    given = read_cloud(write("ball.xyz", lambda p: np.hstack([p, normals])))
    np.testing.assert_allclose(given.normals, normals, atol=1e-6)


def test_some_missing_normals_are_filled(ball):
    write, _, normals = ball
    holes = normals.copy()
    holes[:7] = np.nan
    cloud = read_cloud(write("ball.npz", normals=holes))
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(cloud.normals[7:], normals[7:], atol=1e-6)
    assert any("7 of 2,000" in note for note in cloud.notes)


def test_nan_and_zero_depth_are_dropped_and_told(ball):
    write, points, _ = ball

    def holes(p):
        p[10:30] = np.nan
        p[40:45] = 0.0
        return p.reshape(40, 50, 3)

    labels = np.arange(2000).reshape(40, 50) // 1000
    cloud = read_cloud(write("ball.npz", holes, labels=labels), label=0)
    kept = np.delete(np.arange(2000), [*range(10, 30), *range(40, 45)])
    np.testing.assert_allclose(cloud.points, points[kept], atol=1e-6)
    np.testing.assert_array_equal(cloud.target, kept < 1000)
    assert any("dropped 20 of 2,000" in n for n in cloud.notes)
    assert any("dropped 5 of 2,000" in n for n in cloud.notes)


def test_normals_of_another_form_are_refused(ball):
    write, _, normals = ball
    for given in (normals.T.copy(), normals.astype(str), normals.reshape(50, 40, 3)):
        with pytest.raises(CloudError, match=r"ball.npz: normals are an array of .*; three numbers for each is"):
            read_cloud(write("ball.npz", lambda p: p.reshape(40, 50, 3), normals=given))
    image = read_cloud(write("ball.npz", lambda p: p.reshape(40, 50, 3), normals=normals.reshape(40, 50, 3)))
    np.testing.assert_allclose(image.normals, normals, atol=1e-6)


def test_mask_file(ball, tmp_path):
    write, points, _ = ball
    np.save(tmp_path / "mask.npy", points[:, 2] > CENTRE[2])
    cloud = read_cloud(write(), tmp_path / "mask.npy")
    np.testing.assert_array_equal(cloud.target, points[:, 2] > CENTRE[2])


def test_scale(ball):
    write, points, _ = ball
    cloud = read_cloud(write("ball.npy", lambda p: 1000 * p), scale=0.001)
    np.testing.assert_allclose(cloud.points, points, atol=1e-6)


def test_a_scene_may_be_larger_than_what_is_grasped(ball):
    """A room with a ball in it: fine with the ball's label, and without any as a scene, but nothing to grasp."""
    write, points, _ = ball
    room = np.random.default_rng(1).uniform(-6, 6, (2000, 3))
    path = write("room.npz", lambda p: np.concatenate([p, room]), labels=np.repeat([4, 0], 2000))
    cloud = read_cloud(path, label=4, viewpoint=[0, 0, 0])
    np.testing.assert_allclose(cloud.only(cloud.target).points, points, atol=1e-6)
    assert read_cloud(path, viewpoint=[0, 0, 0]).target.all()
    with pytest.raises(CloudError, match=r"without --label, is 1[12].* m long; at most 2 m"):
        read_cloud(path, viewpoint=[0, 0, 0], scene=False)
    with pytest.raises(CloudError, match=r"the cloud is 1.*e.* m long; at most 20 m is accepted"):
        read_cloud(
            write("room.npz", lambda p: np.concatenate([p, 1e3 * room]), labels=np.repeat([4, 0], 2000)), label=4
        )


def test_strays_of_a_mask_are_surroundings(ball, tmp_path):
    """The edge of a mask on what lies behind: those points stay in the cloud, but are not the target."""
    write, _, normals = ball
    behind = np.array([0.0, 0.0, 1.5])
    path = write("ball.npz", lambda p: np.concatenate([p[:-8], p[-8:] + behind]), normals=normals)
    np.save(tmp_path / "mask.npy", np.ones(2000, bool))
    cloud = read_cloud(path, tmp_path / "mask.npy")
    np.testing.assert_array_equal(cloud.target, np.arange(2000) < 1992)
    assert len(cloud) == 2000
    assert any("8 of 2,000 points lie far from the rest" in note for note in cloud.notes)


def test_a_mesh_is_a_cloud_with_the_normals_of_its_faces(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    mesh.export(tmp_path / "a.ply")
    cloud = read_cloud(tmp_path / "a.ply")
    np.testing.assert_allclose(cloud.points, mesh.vertices, atol=1e-6)
    assert (cloud.normals * mesh.vertices / RADIUS).sum(1).min() > 0.999
    assert any("is a mesh" in note for note in cloud.notes)
    trimesh.creation.box((0.1,) * 3).export(tmp_path / "box.ply")
    with pytest.raises(CloudError, match=r"8 usable points.*it is a mesh, which --object takes"):
        read_cloud(tmp_path / "box.ply")


def fill(value):
    return lambda p: np.full_like(p, value)


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        (fill(np.nan), {}, "all 2,000 points are NaN"),
        (lambda p: p[:12], {}, "12 usable points; at least 50"),
        (lambda p: 1000 * p, {}, "millimetres use --scale 0.001"),
        (lambda p: p, {"scale": 0.001}, "in metres already: use --scale 1"),
        (lambda p: p, {"scale": -1}, "scale -1 cannot be used"),
        (lambda p: (p - CENTRE)[p[:, 2] > CENTRE[2] - 0.01], {}, "give its position as --viewpoint"),
        (lambda p: p[:0], {}, "it has no points; at least 50"),
        (lambda p: p, {"viewpoint": [0, 0]}, "x y z of the camera"),
        (lambda p: p, {"label": 1}, "has no labels; give --mask"),
        (lambda p: p[:, :2], {}, "shape (2000, 2)"),
    ],
)
def test_refused(ball, change, options, words):
    write, _, _ = ball
    path = write("ball.npy", change)
    with pytest.raises(CloudError, match=r"^.*$") as caught:
        read_cloud(path, **options)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_mask_that_selects_nothing_names_its_labels(ball, tmp_path):
    write, _, _ = ball
    np.save(tmp_path / "mask.npy", np.repeat([0, 4], [500, 1500]))
    with pytest.raises(CloudError, match=r"label 9 selects 0 points.*its labels are 0 \(500 points\), 4 \(1,500 "):
        read_cloud(write(), tmp_path / "mask.npy", 9)
    with pytest.raises(CloudError, match="give --label; its labels are 0"):
        read_cloud(write(), tmp_path / "mask.npy")
    np.save(tmp_path / "mask.npy", np.zeros(7, int))
    with pytest.raises(CloudError, match="7 labels for a cloud of 2,000 points"):
        read_cloud(write(), tmp_path / "mask.npy", 1)
    for value in (0.5, np.inf):
        np.save(tmp_path / "mask.npy", np.full(2000, value))
        with pytest.raises(CloudError, match=f"label {value}; whole numbers"):
            read_cloud(write(), tmp_path / "mask.npy", 1)


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.pcd", b"x", "suffix '.pcd' is unknown"),
        ("a.ply", b"", "0 bytes"),
        ("a.ply", b"ply\nnonsense", "not a readable .ply cloud"),
        ("a.npy", b"nonsense", "not a readable .npy cloud"),
        ("a.npz", b"PK\x03\x04", "not a readable .npz cloud"),
        ("a.xyz", b"one two three", "not a readable .xyz cloud"),
    ],
)
def test_files_that_are_no_clouds(tmp_path, name, data, words):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(CloudError) as caught:
        read_cloud(tmp_path / name)
    assert words in str(caught.value)
    with pytest.raises(CloudError, match="does not exist"):
        read_cloud(tmp_path / "absent.npy")
