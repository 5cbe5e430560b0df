"""``lgrasp export``: options, one line for every failure, Ctrl-C."""

import os
import re
import signal
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from support.forked import start_forked
from support.places import TINY_SHARD

from lgrasp.dataset.exports.formats import FORMATS, export_shards, read_grasps
from lgrasp.errors import PhysicsError
from lgrasp_cli.main import main
from lgrasp_cli.progress import JobProgress

GENERATED = TINY_SHARD  # lgrasp generate --object tiny -n 10


@pytest.fixture
def cli(monkeypatch, capfd, tmp_path):
    """cli(*arguments): exit code, standard output, standard error."""
    monkeypatch.setenv("LGRASP_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["lgrasp", "export", *map(str, arguments)])
        with pytest.raises(SystemExit) as leaving:
            main()
        out, err = capfd.readouterr()
        return int(leaving.value.code or 0), out, err

    return call


@pytest.mark.parametrize("form", ["dexgraspnet", "mjcf"])
def test_export(cli, tmp_path, shards, form):
    holds = np.array([True, False, True, True, False, True])
    shards.make(tmp_path / "a.h5", holds=holds)
    more = ("--limit", 3, "--only-holding", "--where", "candidate > 0")
    code, out, err = cli("a.h5", "--to", form, "--out", "made", *more)
    assert (code, err) == (0, "")
    assert re.fullmatch(rf"grasps  3 of 1 object, {form}\ntime    [^\n]*\nwhere   made\n", out)
    assert len(read_grasps(tmp_path / "made", form).grasps) == 3
    assert {p.name for p in (tmp_path / "made").iterdir()} == {"README.txt", "export.json", "grasps", "hand", "objects"}
    assert not list((tmp_path / "made").rglob("*.tmp"))
    assert cli("a.h5", "--to", form, "--out", "quiet", "--quiet") == (0, "", "")


def test_help(cli):
    code, out, _ = cli("--help")
    assert code == 0
    assert "Example: lgrasp export" in out
    assert all(form in out for form in FORMATS)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["a.h5", "--to", "dexgraspnt", "--out", "made"], "choose dexgraspnet, dexgraspbench"),
        (["a.h5", "--to", "mjcf"], "--out"),
        (["a.h5", "--out", "made"], "--to"),
        (["--to", "mjcf", "--out", "made"], "SHARDS"),
        (["b.h5", "--to", "mjcf", "--out", "made"], "b.h5: no such file"),
        (["note.txt", "--to", "mjcf", "--out", "made"], "note.txt: not a whole HDF5 file"),
        (["a.h5", "--to", "mjcf", "--out", "note.txt"], "note.txt is a file"),
        (["a.h5", "--to", "mjcf", "--out", "."], ". is not empty (it holds a.h5)"),
        (["a.h5", "--to", "mjcf", "--out", "/proc/none"], "/proc/none"),
        (["a.h5", "--to", "mjcf", "--out", "made", "--limit", "0"], "'limit' = 0"),
        (["a.h5", "--to", "mjcf", "--out", "made", "--limit", "x"], "--limit"),
        (["a.h5", "--to", "mjcf", "--out", "made", "--where", "a ="], "--where 'a ='"),
        (["a.h5", "--to", "mjcf", "--out", "made", "--only-holding"], "no column 'physics/fc_holds'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input(cli, tmp_path, shards, arguments, words):
    shards.make(tmp_path / "a.h5", n=1)
    (tmp_path / "note.txt").write_text("mine")
    code, out, err = cli(*arguments)
    assert (code, out) == (2, "")
    (line,) = err.splitlines()
    assert line.startswith("error: ")
    assert words in line
    assert {p.name for p in tmp_path.iterdir()} <= {"a.h5", "note.txt", "cache"}


def test_without_mujoco(cli, tmp_path, shards, monkeypatch):
    shards.make(tmp_path / "a.h5", n=1)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    code, _, err = cli("a.h5", "--to", "mjcf", "--out", "made")
    assert code == 2
    assert 'pip install "lgrasp[sim]"' in err
    with pytest.raises(PhysicsError):
        export_shards([tmp_path / "a.h5"], tmp_path / "made", "mjcf", cut=pytest.fail)
    assert not (tmp_path / "made").exists()


def test_a_flat_object_is_refused_by_name(cli, tmp_path, shards):
    flat = shards.object()
    shards.make(
        tmp_path / "a.h5", n=1, objects=[replace(flat, vertices=flat.vertices * np.array([1, 1, 0], np.float32))]
    )
    code, _, err = cli("a.h5", "--to", "mjcf", "--out", "made")
    assert (code, len(err.splitlines())) == (2, 1)
    assert "cup" in err
    assert "flat" in err
    assert not (tmp_path / "made").exists()


def test_interrupted(tmp_path, shards):
    """Ctrl-C: exit code 130, every file whole, the export marked as not whole."""
    shards.make(tmp_path / "a.h5", n=20_000)
    command = ["export", "a.h5", "--to", "dexgraspbench", "--out", "made"]
    job = start_forked(command, tmp_path, os.environ, tmp_path / "said.txt")
    folder = tmp_path / "made" / "grasps" / "cup"
    end = time.monotonic() + 60
    while not (folder.is_dir() and len(os.listdir(folder)) > 20) and time.monotonic() < end:
        time.sleep(0.02)
    os.kill(job.pid, signal.SIGINT)
    assert job.wait(20) == 130
    assert (tmp_path / "said.txt").read_text().splitlines()[-1].startswith("interrupted")
    files = sorted(folder.iterdir())
    assert [path.name for path in files] == [f"{n:08d}.npy" for n in range(len(files))]
    assert all(np.load(path, allow_pickle=True).item()["obj_scale"] == 1 for path in files[-5:])
    assert not (tmp_path / "made" / "export.json").exists()


def test_an_interrupted_export_is_gone_on_with(cli, tmp_path, shards, monkeypatch):
    """By the same command only; in the end it is as if nothing had happened."""
    shards.make(tmp_path / "a.h5", n=6)
    command = ("a.h5", "--to", "dexgraspbench", "--out", "made")
    with monkeypatch.context() as patch:
        patch.setattr(JobProgress, "cancelled", lambda self: (tmp_path / "made").exists())
        assert cli(*command)[0] == 130
    left = tmp_path / "made" / "hand" / "hand.0123456789ab.urdf.tmp"
    left.touch()
    code, _, err = cli(*command, "--limit", 3)
    assert code == 2
    assert "made is not empty" in err
    assert cli(*command)[0] == 0
    assert cli(*command[:-1], "whole")[0] == 0
    whole, made = (
        {path.relative_to(folder): path.is_file() and path.read_bytes() for path in folder.rglob("*")}
        for folder in (tmp_path / "whole", tmp_path / "made")
    )
    assert made == whole


def test_scenes_hold_their_grasps(tmp_path):
    """Ten grasps of the generator in MuJoCo: nothing overlaps at the grasp, squeezing keeps objects in the hand."""
    mujoco = pytest.importorskip("mujoco")
    export_shards(GENERATED, tmp_path / "made", "mjcf")
    kept = 0
    for path in sorted((tmp_path / "made" / "grasps").iterdir()):
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, model.key("grasp").id)
        mujoco.mj_forward(model, data)
        assert min([0, *data.contact.dist[: data.ncon]]) > -2e-3
        mujoco.mj_resetDataKeyframe(model, data, model.key("squeeze").id)
        mujoco.mj_kinematics(model, data)
        start = data.body("object_0_tiny").xpos.copy()
        for _ in range(125):
            mujoco.mj_step(model, data)
        kept += np.linalg.norm(data.body("object_0_tiny").xpos - start) < 0.02
    assert kept >= 9


def test_what_is_left_out_is_told_once(cli, tmp_path, shards):
    (tmp_path / "grasps").mkdir()
    shards.make(tmp_path / "grasps" / "a.h5", n=3)
    two = [shards.object(), shards.object("jug", digit="2")]
    shards.make(tmp_path / "grasps" / "b.h5", objects=two, index=np.array([[0, 1], [1, 0]]), n=2)
    (tmp_path / "grasps" / "c.h5").write_text("no shard")
    code, out, err = cli("grasps", "--to", "isaac-grasp", "--out", "made")
    assert code == 0, err
    assert "3 of 1 object" in out
    (line,) = set(err.splitlines())  # each call of main adds one that prints it
    assert "2 of 3 files are left out" in line


def test_an_export_that_is_replaced(cli, tmp_path, shards):
    """--overwrite leaves nothing of the export before, and touches no file that is not of it."""
    first = shards.make(tmp_path / "a.h5", n=9)
    assert cli("a.h5", "--to", "isaac-grasp", "--out", "made")[0] == 0
    shards.make(tmp_path / "a.h5", n=4, objects=[shards.object("jug")])
    assert cli("a.h5", "--to", "graspgen", "--out", "made")[0] == 2
    (tmp_path / "made" / "notes.txt").write_text("mine")
    code, _, err = cli("a.h5", "--to", "graspgen", "--out", "made", "--overwrite")
    assert (code, "made holds notes.txt, which is not of the export" in err) == (2, True)
    assert len(read_grasps(tmp_path / "made", "isaac-grasp").grasps) == len(first.grasps)
    (tmp_path / "made" / "notes.txt").unlink()
    code, _, err = cli("a.h5", "--to", "graspgen", "--out", "made", "--overwrite", "--where", "metrics/epsilon > 99")
    assert (code, "none satisfies" in err) == (2, True)
    assert len(read_grasps(tmp_path / "made", "isaac-grasp").grasps) == len(first.grasps)
    assert cli("a.h5", "--to", "graspgen", "--out", "made", "--overwrite")[0] == 0
    assert len(read_grasps(tmp_path / "made", "graspgen").grasps) == 4
    assert not [path for path in (tmp_path / "made").rglob("*") if "cup" in path.name or path.suffix == ".yaml"]
