"""``lgrasp refine``."""

import json
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest
import trimesh

from lgrasp.dataset.exports.formats import read_grasps
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard


@pytest.fixture
def shards(generate, once, tmp_path):
    if not (once / "out").exists():
        assert generate(rows=8, out=once / "out").code == 0
    return shutil.copytree(once / "out", tmp_path / "out")


def test_shards(cli, shards, tmp_path):
    out = tmp_path / "refined"
    found = cli("refine", shards, "--out", out, "--device", "cpu", "--json", "-")
    assert found.code == 0, found
    (data,) = json.loads(found.out)["results"]
    (source,) = shards.glob("*.h5")
    before, after = read_shard(source).grasps, read_shard(out / source.name).grasps
    assert validate_shard(out / source.name) == []
    assert data["valid"] >= data["valid_before"]
    refined = after.metrics["refined"] == 1
    assert refined.sum() == data["refined"]
    np.testing.assert_array_equal(after.q[~refined], before.q[~refined])
    np.testing.assert_array_equal(after.candidate, before.candidate)
    terms = sum(
        after.metrics[f"energy_{name}"] for name in ("points", "normals", "force", "barrier", "overlap", "limits")
    )
    np.testing.assert_allclose(after.metrics["energy"], terms, rtol=1e-4)
    again = cli("refine", shards, "--out", out, "--device", "cpu", "--json", "-")
    assert (json.loads(again.out)["made"], json.loads(again.out)["results"]) == (0, [data])
    assert "--overwrite" in cli("refine", shards, "--out", out, "--device", "cpu", "--coarse").error()


def test_bounds_and_rows_that_fail_them(cli, shards, tmp_path):
    """With a bound that hardly any row meets, the others are left out, or kept and marked."""
    quick = ("--matching-rounds", 1, "--set", "refine.tries=1", "--set", "bounds.max_gap=2e-5", "--device", "cpu", "-q")
    (source,) = shards.glob("*.h5")
    rows = len(read_shard(source).grasps)
    assert cli("refine", shards, "--out", tmp_path / "all", "--keep-invalid", *quick).code == 0
    after = read_shard(tmp_path / "all" / source.name)
    assert len(after.grasps) == rows
    valid = after.grasps.metrics["valid"] == 1
    assert (~valid).sum() > 0
    assert after.grasps.metrics["gap"][valid].max(initial=0) <= 2.1e-5
    assert (after.grasps.metrics["gap"][after.grasps.failed_bound == "max_gap"] > 2e-5).all()
    assert ((after.grasps.failed_bound == "none") == valid).all()
    assert after.header.config["bounds"]["numbers"]["max_gap"] == 2e-5
    assert (
        "did you mean 'bounds.max_gap'"
        in cli("refine", shards, "--out", tmp_path / "x", "--set", "bounds.gap=1", "--device", "cpu").error()
    )


def test_exports_of_other_programs(cli, shards, tmp_path):
    folder, out = tmp_path / "export", tmp_path / "refined"
    assert cli("export", shards, "--to", "dexgraspnet", "--out", folder).code == 0
    found = cli(
        "refine",
        folder,
        "--from",
        "dexgraspnet",
        "--hand",
        "allegro",
        "--out",
        out,
        "--device",
        "cpu",
        "--keep-invalid",
    )
    assert found.code == 0, found
    (path,) = out.glob("*.h5")
    (source,) = shards.glob("*.h5")
    assert validate_shard(path) == []
    after, before = read_shard(path).grasps, read_shard(source).grasps
    assert read_shard(path).statistics["refine_valid_before"] == len(before)  # as they were in the shard
    kept = after.metrics["refined"] == 0
    np.testing.assert_allclose(after.q[kept], before.q[kept], atol=1e-5)
    assert "--hand" in cli("refine", folder, "--from", "dexgraspnet", "--out", tmp_path / "x").error()


def spoilt(shards, folder, **changes):
    """A folder with a copy of the shard, row 3 of datasets changed behind the writer's back."""
    folder.mkdir()
    (source,) = shards.glob("*.h5")
    shutil.copy(source, folder)
    with h5py.File(folder / source.name, "r+") as file:
        for name, change in changes.items():
            file[f"grasps/{name}"][3] = change(file[f"grasps/{name}"][3])
    return folder


def put(value, *columns):
    """A change of some columns of a row."""
    return lambda row: np.where(np.isin(np.arange(row.shape[-1]), columns), value, row)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("q", put(np.nan, 2), "grasps/q: not finite (row 3, 1 rows)"),
        ("q", put(np.inf, 2), "grasps/q: not finite (row 3, 1 rows)"),
        ("q_squeeze", put(np.nan, 2), "grasps/q_squeeze: not finite (row 3"),
        ("object_pose", put(np.nan, 0), "grasps/object_pose: NaN"),
        ("object_pose", put(0.0, 3, 4, 5, 6), "quaternion is not of unit length (row 3"),
    ],
)
def test_rows_that_cannot_be_repaired(cli, shards, tmp_path, name, change, words):
    folder = spoilt(shards, tmp_path / "spoilt", **{name: change})
    line = cli("refine", folder, "--out", tmp_path / "x", "--device", "cpu").error()
    assert words in line
    assert str(folder / "allegro-tiny-00000.h5") in line
    assert not (tmp_path / "x").exists()


def test_joints_outside_their_limits_are_clamped(cli, shards, tmp_path):
    folder, out = spoilt(shards, tmp_path / "spoilt", q=put(9.0, 2)), tmp_path / "refined"
    options = ("--keep-invalid", "--matching-rounds", 1, "--device", "cpu", "--json", "-")
    found = cli("refine", folder, "--out", out, *options)
    assert found.code == 0, found
    assert found.err.startswith("warning: joints of 1 rows were outside their limits")
    (data,) = json.loads(found.out)["results"]
    assert data["energy_before"] < 1.0  # that of the joints within
    (path,) = out.glob("*.h5")
    assert validate_shard(path) == []
    shard = read_shard(path)
    assert shard.grasps.q[3, 2] == pytest.approx(shard.hand.joint_upper[2], abs=0.05)


def test_control_poses_of_another_version_are_made_again(cli, shards, tmp_path):
    """It may have opened hands that pass each other as they close; joints and pose of valid rows stay."""
    (source,) = shards.glob("*.h5")
    shard = read_shard(source)
    config = json.loads(json.dumps(shard.header.config))
    (filtered,) = (stage["filter"] for stage in config["pipeline"]["stages"] if "filter" in stage)
    opened = shard.grasps.q_pregrasp.copy()
    opened[:, 2] += 1e-3
    for version in (filtered["version"], 1):
        filtered["version"] = version
        rows, out = replace(shard.grasps, q_pregrasp=opened), tmp_path / f"refined{version}"
        write_shard(source, replace(shard, header=replace(shard.header, config=config), grasps=rows))
        assert cli("refine", shards, "--out", out, "--matching-rounds", 1, "--device", "cpu").code == 0
        after = read_shard(out / source.name).grasps
        stay = after.metrics["refined"] == 0
        assert stay.any()
        np.testing.assert_array_equal(after.q[stay], shard.grasps.q[stay])
        assert (after.q_pregrasp[stay] == opened[stay]).all() == (version != 1)


def test_no_row_that_passes(cli, shards, tmp_path):
    """The files are there and hold nothing, which a script is told."""
    folder, out = spoilt(shards, tmp_path / "spoilt"), tmp_path / "refined"
    with h5py.File(folder / "allegro-tiny-00000.h5", "r+") as file:
        file["grasps/object_pose"][..., 0] += 3.0
    for _ in range(2):
        found = cli("refine", folder, "--out", out, "--matching-rounds", 1, "--device", "cpu")
        assert found.code == 3
        assert found.err.endswith(f"error: none of the rows passed the checks; the files in {out} hold no grasps\n")
        assert "next" not in found.out


def test_hands_that_are_far_off_are_told(cli, shards, tmp_path):
    folder, out = spoilt(shards, tmp_path / "spoilt", object_pose=put(3.0, 0)), tmp_path / "refined"
    found = cli("refine", folder, "--out", out, "--matching-rounds", 1, "--device", "cpu", "-q")
    assert found.code == 0, found
    assert "the hands of 1 rows are more than half a metre from their object" in found.err
    (path,) = out.glob("*.h5")
    assert read_shard(path).grasps.metrics["refined"][3] == 0


@pytest.fixture
def export(cli, shards, tmp_path):
    """export(change): the grasps in format dexgraspnet, their entries changed."""
    assert cli("export", shards, "--to", "dexgraspnet", "--out", tmp_path / "export").code == 0

    def export(change=lambda entries: entries):
        path = tmp_path / "export" / "grasps" / "tiny.npy"
        entries = change(list(np.load(path, allow_pickle=True)))
        out = np.empty(len(entries), object)
        out[:] = entries
        np.save(path, out, allow_pickle=True)
        return tmp_path / "export"

    return export


def with_values(**values):
    """Entry 2 with other values of its posture."""

    def change(entries):
        entries[2]["qpos"] |= values
        return entries

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (with_values(**{"joint_1.0": np.nan}), "entry 2: not a grasp of DexGraspNet: qpos is not finite"),
        (with_values(WRJTx=np.inf), "entry 2: not a grasp of DexGraspNet: qpos is not finite"),
        (with_values(extra=0.0), "entry 2: has joint 'extra'; expected joint_0.0"),
        (
            lambda entries: [e | {"scale": np.nan} for e in entries],
            "entry 0: not a grasp of DexGraspNet: scale is not finite",
        ),
        (lambda entries: [e | {"scale": 1000.0} for e in entries], "90 m at scale 1000; 0.005 to 1 m is accepted"),
        (lambda entries: [], "holds no grasps"),
    ],
)
def test_bad_exports(cli, export, tmp_path, change, words):
    base = ["--from", "dexgraspnet", "--hand", "allegro", "--device", "cpu", "--out", tmp_path / "x"]
    assert words in cli("refine", export(change), *base).error()
    assert not (tmp_path / "x").exists()


def test_an_object_in_two_scales(cli, export, tmp_path):
    """Each scale has a shard of its own, and no row is lost; rows of another scale are other rows."""
    folder = export(lambda entries: [e | {"scale": 1.0 + 0.1 * (k < 3)} for k, e in enumerate(entries)])
    quick = ("--matching-rounds", 1, "--set", "refine.tries=1", "--keep-invalid", "--device", "cpu", "-q")
    refine = ("refine", folder, "--from", "dexgraspnet", "--hand", "allegro", *quick, "--out", tmp_path / "x")
    assert cli(*refine).code == 0
    shards = [read_shard(path) for path in sorted((tmp_path / "x").glob("allegro-tiny-*.h5"))]
    assert [(s.objects[0].scale, len(s.grasps), s.header.shard_index) for s in shards] == [(1.1, 3, 0), (1.0, 5, 1)]
    export(lambda entries: [e | {"scale": 1.2 - 0.2 * (k >= 3)} for k, e in enumerate(entries)])
    assert "--overwrite" in cli(*refine).error()


def test_exports_of_another_hand_or_without_a_mesh(cli, export, tmp_path):
    base = [export(), "--from", "dexgraspnet", "--device", "cpu", "--out", tmp_path / "x", "--hand"]
    assert "entry 0: lacks joint 'finger_1_med_joint'" in cli("refine", *base, "barrett").error()
    mesh = (tmp_path / "export/objects/tiny.obj").rename(tmp_path / "tiny.obj")
    assert "objects/tiny.obj: does not exist" in cli("refine", *base, "allegro").error()
    (tmp_path / "bare/objects").mkdir(parents=True)  # what another program writes
    (tmp_path / "export/grasps").rename(tmp_path / "bare/grasps")
    base[0] = tmp_path / "bare"
    line = cli("refine", *base, "allegro").error()
    assert f"no mesh of object 'tiny'; {tmp_path}/bare/objects/tiny.obj (or .stl, " in line
    trimesh.load_mesh(mesh).export(tmp_path / "bare/objects/tiny.stl")
    for place in ("bare", "bare/grasps", "bare/grasps/tiny.npy"):
        assert [o.mesh.name for o in read_grasps(tmp_path / place, "dexgraspnet").objects] == ["tiny.stl"]
    assert "choose dexgraspnet" in cli("refine", "export", "--from", "x", *base[3:], "allegro").error()
    assert not (tmp_path / "x").exists()


def of_another_run(path, copy):
    """The same rows, as if they came from elsewhere: of one run they would count once."""
    shard = read_shard(path)
    config = {**shard.header.config, "run_key": str(copy)}
    write_shard(copy, replace(shard, header=replace(shard.header, config=config)))


def test_bad_input(cli, shards, tmp_path):
    out = ("--out", tmp_path / "x")
    assert "nothing: no such file" in cli("refine", "nothing", *out).error()
    assert "'gradient_steps' = 0" in cli("refine", shards, *out, "--gradient-steps", 0).error()
    assert "'outer' is now called 'matching_rounds'" in cli("refine", "nothing", *out, "--outer", 3).err
    line = cli("refine", shards, *out, "--hand", "barrett").error()
    assert "allegro-tiny-00000.h5: its grasps are of hand 'allegro'" in line
    assert "not of 'barrett'" in line
    (path,) = shards.glob("*.h5")
    other = tmp_path / "other" / path.name
    other.parent.mkdir()
    other.write_bytes(path.read_bytes()[:9000])
    assert f"{other}: " in cli("refine", other, *out).error()
    of_another_run(path, other)
    assert "name one folder above both" in cli("refine", shards, other.parent, *out).error()
    assert "is a file" in cli("refine", shards, "--out", path).error()
    assert not (tmp_path / "x").exists()


def test_a_tree_of_shards_stays_a_tree(cli, shards, tmp_path):
    (path,) = shards.glob("*.h5")
    for name in ("a", "b"):
        of_another_run(path, tmp_path / "tree" / name / path.name)
    quick = ("--device", "cpu", "--matching-rounds", 1, "--gradient-steps", 1, "-q")
    assert cli("refine", tmp_path / "tree", "--out", tmp_path / "x", *quick).code == 0
    assert sorted(p.parent.name for p in (tmp_path / "x").rglob("*.h5")) == ["a", "b"]
    (tmp_path / "x" / "a" / path.name).unlink()
    kept = (tmp_path / "x" / "b" / path.name).stat().st_mtime_ns
    assert cli("refine", tmp_path / "tree", "--out", tmp_path / "x", *quick).code == 0
    assert (tmp_path / "x" / "a" / path.name).is_file()
    assert (tmp_path / "x" / "b" / path.name).stat().st_mtime_ns == kept


def test_plans_of_a_cloud_can_be_refined(cli, tmp_path):
    n = np.asarray(trimesh.creation.icosphere(subdivisions=3).vertices)
    np.savez(tmp_path / "ball.npz", points=0.035 * n, normals=n)
    planned, out = tmp_path / "planned", tmp_path / "refined"
    cloud = ("plan", "--cloud", tmp_path / "ball.npz", "--starts", 2, "--device", "cpu", "-q")
    assert cli(*cloud, "--out", planned).code == 0
    assert (
        cli("refine", planned, "--out", out, "--keep-invalid", "--matching-rounds", 1, "--device", "cpu", "-q").code
        == 0
    )
    before, after = (read_shard(next(folder.glob("*.h5"))) for folder in (planned, out))
    np.testing.assert_array_equal(after.objects[0].normals, before.objects[0].normals)
    assert (after.grasps.metrics["energy"] > 0).all()
    assert "is a point cloud" in cli("simulate", planned, "--out", tmp_path / "x").error()
