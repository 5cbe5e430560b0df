"""Scenes from start to end: what is in the files, and that they depend on number and seed only."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from support.places import QUICK

from lgrasp.cloud.read import read_cloud
from lgrasp.dataset.reader import read_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import Events, JobOutcome
from lgrasp.engine.run import run
from lgrasp.errors import CloudError, ConfigError, LgraspError, OutputError, ShardError
from lgrasp.geometry.poses import pose_matrix
from lgrasp.jobs.config import read_scene_config, scene_configs
from lgrasp.jobs.scenes.job import SceneJob, describe_scenes
from lgrasp.scenes.files import SceneReader, check_scene, read_scene, scene_cloud, write_scene

OBJECTS = ["box", "sphere", "tiny"]
SCENES = 2


@pytest.fixture(scope="module")
def make(cache_root: Path):
    """make(out, task=(0, 1), **changes): run a small job on the CPU."""

    def make(out: Path, task=(0, 1), listener=None, *, resume=True, **changes) -> JobOutcome:
        data = {
            "hand": "allegro",
            "objects": OBJECTS,
            "pipeline": QUICK,
            "stock": 40,
            "scenes": SCENES,
            "out": out,
            "device": "cpu",
            "workers": 1,
            "scene": {"objects": 4, "grasps": 10, "colliding": 5, "camera": {"width": 120, "height": 90}},
        }
        job = SceneJob(**data | changes, cache=Cache(cache_root))
        return run(job, listener, array=task, resume=resume)

    return make


@pytest.fixture(scope="module")
def folder(make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("scenes") / "a"
    outcome = make(out)
    assert len(outcome.written) == SCENES
    return out


def files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.h5"))


def contents(path: Path) -> dict[str, bytes]:
    """Every array of a scene."""
    found = {}

    def visit(name, node):
        if isinstance(node, h5py.Dataset):
            found[name] = np.asarray(node[()]).tobytes()

    with h5py.File(path) as file:
        file.visititems(visit)
    return found


def test_files_conform(folder):
    assert [path.name for path in files(folder)] == [f"allegro-scene-{k:05d}.h5" for k in range(SCENES)]
    assert all(check_scene(path) == [] for path in files(folder))


def test_cloud_lies_on_what_its_labels_say(folder):
    for path in files(folder):
        scene = read_scene(path)
        cloud = scene.cloud
        true = cloud.points - scene.views.offset[cloud.view]
        assert np.abs(true[cloud.labels == 0, 2]).max() < 0.02  # noise of 1 to 3 mm, seen askew
        seen = 0
        for k, T in enumerate(pose_matrix(scene.object_pose.astype(float))):
            own = true[cloud.labels == k + 1]
            record = scene.objects[scene.object_index[k]]
            mesh = trimesh.Trimesh(record.vertices @ T[:3, :3].T + T[:3, 3], record.faces, process=False)
            if len(own):
                away = trimesh.proximity.closest_point(mesh, own[::20])[1]
                assert np.median(away) < 2.5e-3
                seen += len(own)
            assert mesh.bounds[0, 2] > -2e-3
        assert seen > 200


def test_masks_and_depths_give_the_cloud(folder):
    scene = read_scene(files(folder)[0])
    views, points = scene.views, []
    T = pose_matrix(views.pose.astype(float))
    local = views.intrinsics.points(views.depth * 1e-4)
    for k in range(len(T)):
        points.append((local[k] @ T[k][:3, :3].T + T[k][:3, 3] + views.offset[k])[views.labels[k] >= 0])
    from scipy.spatial import KDTree

    away, _ = KDTree(np.concatenate(points)).query(scene.cloud.points)
    assert away.max() < 1e-5
    np.testing.assert_allclose(np.linalg.norm(views.offset, axis=1), 0.01, rtol=1e-5)


def test_grasps_are_those_of_the_shards(folder):
    shards = {name: read_shard(next((folder / "grasps").glob(f"allegro-{name}/*.h5"))).grasps for name in OBJECTS}
    kept = 0
    for path in files(folder):
        scene = read_scene(path)
        grasps = scene.grasps
        for i in range(len(grasps)):
            record = scene.objects[int(scene.object_index[grasps.target[i]])]
            rows = shards[record.name]
            (row, *_) = np.flatnonzero((rows.candidate == grasps.candidate[i]) & (rows.q == grasps.q[i]).all(axis=1))
            np.testing.assert_array_equal(rows.q_pregrasp[row], grasps.q_pregrasp[i])
            found = pose_matrix(grasps.hand_pose[i].astype(float)) @ pose_matrix(rows.object_pose[row, 0].astype(float))
            T = pose_matrix(scene.object_pose[grasps.target[i]].astype(float))
            np.testing.assert_allclose(found, T, atol=2e-6)
        deepest = np.maximum(grasps.table_depth, grasps.object_depth).max(axis=1)
        np.testing.assert_array_equal(grasps.collision_free, deepest <= np.float32(grasps.tolerance))
        for k in range(len(scene.object_index)):
            own = grasps.collision_free[grasps.target == k]
            assert own.sum() <= 10
            assert (~own).sum() <= 5
        kept += len(grasps)
    assert kept > 0


def test_the_cloud_of_a_scene_is_read_like_any_other(folder):
    path = files(folder)[0]
    cloud, scene = read_cloud(path, label=2, read_scene=scene_cloud), read_scene(path)
    np.testing.assert_array_equal(cloud.points, scene.cloud.points)
    np.testing.assert_allclose(cloud.normals, scene.cloud.normals, atol=1e-6)
    np.testing.assert_array_equal(cloud.target, scene.cloud.labels == 2)
    with pytest.raises(CloudError, match="label 9 selects 0 points"):
        read_cloud(path, label=9, read_scene=scene_cloud)


def test_array_tasks_and_threads_give_the_same_scenes(folder, make, tmp_path):
    for task in range(2):
        make(tmp_path / "b", (task, 2), workers=2, grasps=folder / "grasps", hand=None)
    assert [p.name for p in files(tmp_path / "b")] == [p.name for p in files(folder)]
    for a, b in zip(files(folder), files(tmp_path / "b"), strict=True):
        assert contents(a) == contents(b)


class _Stops(Events):
    """Cancels before the second scene."""

    asked = 0

    def cancelled(self) -> bool:
        self.asked += 1
        return self.asked > 1


def test_resume_keeps_whole_scenes_and_makes_damaged_ones_anew(folder, make, tmp_path):
    out = tmp_path / "c"
    grasps = {"grasps": folder / "grasps"}
    stopped = make(out, listener=_Stops(), **grasps)
    assert stopped.cancelled
    assert len(files(out)) == 1
    first = files(out)[0].read_bytes()
    done = make(out, **grasps)
    assert not done.cancelled
    assert len(done.written) == SCENES - 1
    assert len(done.paths) == SCENES
    assert files(out)[0].read_bytes() == first
    damaged = files(out)[1]
    damaged.write_bytes(damaged.read_bytes()[:-100])
    assert make(out, **grasps).written == [damaged]
    assert contents(damaged) == contents(files(folder)[1])
    with pytest.raises(OutputError, match="belongs to another run"):
        make(out, seed=9, **grasps)


def test_report_counts_what_the_files_hold(folder):
    data = describe_scenes(files(folder))
    scenes = [read_scene(path) for path in files(folder)]
    assert data["points"] == sum(len(s.cloud.points) for s in scenes)
    assert sum(found["free"] for found in data["objects"].values()) == sum(
        s.grasps.collision_free.sum() for s in scenes
    )
    assert sum(found["scenes"] for found in data["objects"].values()) == 4 * SCENES
    assert data["grasps_tested"] >= data["grasps_free"] > 0


def change(path: Path, where: str, edit) -> None:
    with h5py.File(path, "r+") as file:
        values = file[where][()]
        file[where][...] = edit(values)


@pytest.mark.parametrize(
    ("where", "edit", "words"),
    [
        ("cloud/normals", lambda v: 0.5 * v, "cloud/normals: not of unit length"),
        ("cloud/labels", lambda v: v + 100, "cloud/labels: must be 0 to 4"),
        ("views/labels", lambda v: 0 * v, "-1 if and only if the depth is 0"),
        ("scene/object_pose", lambda v: v * np.nan, "scene/object_pose: not finite"),
        ("grasps/collision_free", lambda v: ~v, "does not follow from the depths"),
        ("grasps/q", lambda v: v + 10, "outside the joint limits"),
    ],
)
def test_wrong_values_are_found(folder, tmp_path, where, edit, words):
    path = tmp_path / "x.h5"
    path.write_bytes(files(folder)[0].read_bytes())
    change(path, where, edit)
    (problem,) = [p for p in check_scene(path) if words in p]
    assert "row 0" in problem


def test_a_scene_leads_to_no_other_file(folder, tmp_path):
    path = tmp_path / "x.h5"
    path.write_bytes(files(folder)[0].read_bytes())
    with h5py.File(path, "r+") as file:
        del file["cloud/points"]
        file["cloud/points"] = h5py.ExternalLink(str(files(folder)[1]), "/cloud/points")
    assert check_scene(path) == ["cloud/points: is a link; the file must hold its own data"]
    with pytest.raises(ShardError, match="is a link"):
        SceneReader(path)


def test_other_files_are_no_scenes(folder, tmp_path):
    shard = next((folder / "grasps").glob("*/*.h5"))
    assert "not a scene (attribute format is 'lgrasp-shard'" in check_scene(shard)[0]
    with pytest.raises(ShardError, match="not a scene"):
        SceneReader(shard)
    assert "No such file" in check_scene(tmp_path / "absent.h5")[0]
    scene = read_scene(files(folder)[0])
    with pytest.raises(ShardError, match="object_index: must name every object"):
        write_scene(tmp_path / "y.h5", replace(scene, object_index=scene.object_index * 0))
    assert not (tmp_path / "y.h5").exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"objects": []}, "no objects: name some"),
        ({"objects": ["mugg"]}, "did you mean mug"),
        ({"grasps": "absent"}, "no such file or folder"),
        ({"grasps": "GRASPS", "objects": ["mug"]}, "has no grasps of object 'mug'; it has box, sphere, tiny"),
        ({"grasps": "GRASPS", "hand": "leap"}, "are of hand 'allegro'"),
    ],
)
def test_bad_input_is_one_line(folder, make, tmp_path, changes, words):
    places = {"GRASPS": folder / "grasps", "SCENES": folder}
    changes = {"objects": []} | {k: places.get(v, v) if isinstance(v, str) else v for k, v in changes.items()}
    with pytest.raises(LgraspError) as caught:
        make(tmp_path / "d", **changes)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not files(tmp_path / "d")


def test_configs():
    assert "table" in scene_configs()
    assert all(read_scene_config(name)["objects"] for name in scene_configs())
    with pytest.raises(ConfigError, match="did you mean 'table'"):
        read_scene_config("tabel")
