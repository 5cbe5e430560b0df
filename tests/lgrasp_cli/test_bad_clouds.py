"""Option ``--cloud`` on clouds that cannot be used, or only after a repair that is said."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from lgrasp.dataset.reader import read_shard

BALL = trimesh.creation.icosphere(subdivisions=3)
NORMALS = np.asarray(BALL.vertices)
POINTS = 0.035 * NORMALS + [0, 0, 0.5]
COUNT = len(POINTS)
SHELL = POINTS[POINTS[:, 2] > 0.5] - [0, 0, 0.51]  # one side, about the origin


@pytest.fixture
def plan(cli, tmp_path):
    """plan(*arguments): a few hands at two starts into ./out."""
    few = ("--set", "plan.rolls=10", "--set", "plan.finalists=4")
    return lambda *more: cli("plan", *more, *few, "--starts", 2, "--device", "cpu", "--out", tmp_path / "out")


@pytest.fixture
def refused(plan, tmp_path):
    """refused(*arguments): the one line of the failure, after which nothing was written."""

    def refused(*more):
        line = plan(*more).error()
        assert not (tmp_path / "out").exists()
        return line

    return refused


def changed(where, points=POINTS, normals=NORMALS, **more):
    np.savez(where, points=points, **({} if normals is None else {"normals": normals}), **more)
    return where


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"points": np.full((COUNT, 3), np.nan)}, f"all {COUNT:,} points are NaN"),
        ({"points": POINTS[:7], "normals": NORMALS[:7]}, "7 usable points; at least 50"),
        ({"points": SHELL, "normals": None}, "give its position as --viewpoint X,Y,Z"),
        ({"points": SHELL, "normals": np.zeros(SHELL.shape)}, "give its position as --viewpoint X,Y,Z"),
        ({"normals": NORMALS[:5]}, "normals are an array of float64 of shape (5, 3)"),
        ({"points": 1e3 * POINTS}, "in millimetres use --scale 0.001"),
        ({"points": 1e2 * POINTS}, "in centimetres use --scale 0.01"),
        ({"points": 1e6 * POINTS}, "in micrometres use --scale 1e-06"),
        ({"points": 100 / 0.07 * POINTS}, "97.9 m long; at most 2 m is accepted"),
        ({"points": 5000 * POINTS}, "342.6 m long; at most 2 m is accepted"),
        ({"points": 1e-6 * POINTS}, "6.9e-08 m long; at least 0.005 m is accepted"),
        ({"points": np.tile(POINTS[:1], (200, 1)), "normals": NORMALS[:200]}, "0 m long; at least 0.005 m"),
    ],
)
def test_clouds(refused, tmp_path, arrays, words):
    line = refused("--cloud", changed(tmp_path / "bad.npz", **arrays))
    assert words in line
    assert "bad.npz" in line


@pytest.mark.parametrize(
    ("labels", "options", "words"),
    [
        (
            np.zeros(COUNT, int),
            ["--label", 3],
            f"label 3 selects 0 points, at least 50 are needed; its labels are 0 ({COUNT:,}",
        ),
        (np.zeros(COUNT, bool), [], "selects 0 points"),
        (np.repeat([3, 0], [20, COUNT - 20]), ["--label", 3], "label 3 selects 20 points"),
        (np.repeat([3, 5], [500, COUNT - 500]), [], "give --label; its labels are 3 (500 points), 5"),
        (np.zeros(7, int), ["--label", 0], f"7 labels for a cloud of {COUNT:,} points"),
        (np.full(COUNT, 0.5), ["--label", 0], "label 0.5; whole numbers or flags are accepted"),
        (np.full(COUNT, "a"), ["--label", 0], "whole numbers or flags are accepted"),
    ],
)
def test_masks(refused, tmp_path, labels, options, words):
    np.save(tmp_path / "mask.npy", labels)
    cloud = changed(tmp_path / "ball.npz")
    line = refused("--cloud", cloud, "--mask", tmp_path / "mask.npy", *options)
    assert words in line
    assert "mask.npy" in line


def test_labels_of_the_cloud_itself(refused, tmp_path):
    cloud = changed(tmp_path / "ball.npz", labels=np.repeat([3, 0], [500, COUNT - 500]))
    assert "its labels are 0 (142 points), 3 (500 points)" in refused("--cloud", cloud, "--label", 9)
    assert "has no labels; give --mask" in refused("--cloud", changed(tmp_path / "bare.npz"), "--label", 3)
    assert "mask.txt: suffix '.txt'" in refused("--cloud", cloud, "--mask", written(tmp_path / "mask.txt", b"1"))
    assert "no.npy: does not exist" in refused("--cloud", cloud, "--mask", "no.npy")
    assert "no NumPy file" in refused("--cloud", cloud, "--mask", written(tmp_path / "mask.npy", b"1 1 1"))
    assert "an array 'labels' is needed" in refused("--cloud", cloud, "--mask", tmp_path / "bare.npz", "--label", 3)


def written(path, data):
    path.write_bytes(data)
    return path


def ply(points=POINTS):
    return trimesh.PointCloud(points).export(file_type="ply")


ASCII = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float {}\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.ply", b"", "0 bytes"),
        ("a.ply", ply()[: len(ply()) // 2], "not a readable .ply cloud"),
        ("a.ply", ply()[:60], "its header has no end"),
        ("a.ply", (ASCII.format(100, "x") + "0.1 0.2 0.3\n" * 60).encode(), "60 of the 100 vertices"),
        ("a.ply", (ASCII.format(1, "a") + "0.1 0.2 0.3\n").encode(), "no x, y and z"),
        ("a.ply", ASCII.format(0, "x").encode(), "no vertices"),
        ("a.npy", b"0 0 0\n", "no NumPy file"),
        ("a.h5", b"0 0 0\n", "not a whole HDF5 file"),
        ("a.obj", b"v 0 0 0\n", "suffix '.obj'"),
        ("a.ply", str(BALL.export(file_type="obj")).encode(), "not a readable .ply cloud"),
    ],
)
def test_files(refused, tmp_path, name, data, words):
    line = refused("--cloud", written(tmp_path / name, data))
    assert words in line
    assert str(tmp_path / name) in line


def test_nothing_is_planned_without_points_that_face_the_hand(plan, tmp_path):
    """Normals that point inwards cannot be told from a hollow: no plan, exit code 3, and what to look at."""
    found = plan("--cloud", changed(tmp_path / "ball.npz", normals=-NORMALS))
    assert "do its normals point out of it (--viewpoint)" in found.error(3)
    (path,) = (tmp_path / "out").rglob("*.h5")
    assert len(read_shard(path).grasps) == 0


def repaired(found, words):
    """The object of the one shard, after a warning."""
    assert found.code == 0, found
    assert words in found.err
    assert found.err.startswith("warning: ")
    (path,) = Path(found.out.split()[found.out.split().index("where") + 1]).glob("*.h5")
    return read_shard(path).objects[0]


def test_points_that_are_nan_are_dropped(plan, tmp_path):
    points = POINTS.copy()
    points[:10] = np.nan
    record = repaired(plan("--cloud", changed(tmp_path / "a.npz", points)), "dropped 10 of 642 points that are NaN")
    np.testing.assert_allclose(record.vertices, POINTS[10:], atol=1e-6)


def test_points_far_off_are_not_grasped(plan, tmp_path):
    """As where the edge of a mask reaches the background."""
    points = POINTS.copy()
    points[:5] += [0, 0, 2.5]
    record = repaired(plan("--cloud", changed(tmp_path / "a.npz", points)), "5 of 642 points lie far from the rest")
    assert len(record.vertices) == COUNT - 5


def test_a_mesh_gives_its_vertices_and_their_normals(plan, tmp_path):
    mesh = BALL.copy()
    mesh.vertices = POINTS
    mesh.export(tmp_path / "mesh.ply")
    record = repaired(plan("--cloud", tmp_path / "mesh.ply"), "mesh.ply is a mesh: its vertices are the points")
    assert (record.normals * NORMALS).sum(1).min() > 0.99
    trimesh.creation.box((0.05,) * 3).export(tmp_path / "box.ply")
    assert "8 usable points" in (line := plan("--cloud", tmp_path / "box.ply", "--overwrite").error())
    assert "--object takes" in line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["mug", "--cloud", "a.npz"], "give objects (meshes or names) or --cloud"),
        (["--cloud", "a.npz"], "at least two objects, got a;"),
        (["--cloud", "a.npz", "--cloud", "no.npz"], "no.npz: does not exist"),
        (["--cloud", "a.npz", "--cloud", "bad.npz"], "bad.npz: all 642 points are NaN"),
        (["--cloud", "a.npz", "--cloud", "a.npz", "--label", 3], "1 --label for 2 --cloud: give one for each, or none"),
        (["--cloud", "a.npz", "--cloud", "a.npz", "--label", 3, "--label", 4], "label 4 selects 0 points"),
        (["--cloud", "a.npz", "--cloud", "a.npz", "--scale", "0.06:0.1"], "clouds have the size that they have"),
        (["--cloud", "a.npz", "--cloud", "a.npz", "--simulate", "seq6"], "a simulator needs meshes"),
        (["--cloud", "a.npz", "--cloud", "a.npz", "--viewpoint", "0,0"], "give 3 numbers, separated by commas"),
        (["mug", "sphere", "--viewpoint", "0,0,0"], "--viewpoint belongs to --cloud"),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, list) else "",
)
def test_clouds_of_sequences(cli, tmp_path, arguments, words):
    changed(tmp_path / "a.npz", labels=np.full(COUNT, 3))
    changed(tmp_path / "bad.npz", np.full((COUNT, 3), np.nan))
    line = cli("sample", "seq-allegro", *arguments, "--device", "cpu", "--out", tmp_path / "out").error()
    assert words in line
    assert not (tmp_path / "out").exists()


def test_scale_turns_millimetres_into_metres(plan, tmp_path):
    found = plan("--cloud", changed(tmp_path / "a.npz", 1000 * POINTS), "--scale", 0.001)
    assert found.code == 0, found
    assert "--scale 1" in plan("--cloud", changed(tmp_path / "b.npz"), "--scale", 0.001).error()
