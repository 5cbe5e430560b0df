"""``lgrasp export``: options, one line for every failure, Ctrl-C."""

import os
import re
import signal
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from support.exported import make_shard, object_record
from support.forked import start_forked

from lgrasp.dataset.exports.formats import FORMATS, export_shards, read_grasps
from lgrasp.errors import PhysicsError
from lgrasp_cli.progress import JobProgress


@pytest.mark.parametrize("form", ["dexgraspnet", "mjcf"])
def test_export(cli, tmp_path, form):
    holds = np.array([True, False, True, True, False, True])
    make_shard(tmp_path / "a.h5", holds=holds)
    more = ("--limit", 3, "--only-holding", "--where", "candidate > 0")
    result = cli("export", "a.h5", "--to", form, "--out", "made", *more)
    assert (result.code, result.err) == (0, "")
    assert re.fullmatch(rf"grasps  3 of 1 object, {form}\ntime    [^\n]*\nwhere   made\n", result.out)
    assert len(read_grasps(tmp_path / "made", form).grasps) == 3
    assert {p.name for p in (tmp_path / "made").iterdir()} == {"README.txt", "export.json", "grasps", "hand", "objects"}
    assert not list((tmp_path / "made").rglob("*.tmp"))
    quiet = cli("export", "a.h5", "--to", form, "--out", "quiet", "--quiet")
    assert (quiet.code, quiet.out, quiet.err) == (0, "", "")


def test_help_tells_the_formats(cli):
    result = cli("export", "--help")
    assert result.code == 0
    assert all(form in result.out for form in FORMATS)


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
def test_bad_input(cli, tmp_path, arguments, words):
    make_shard(tmp_path / "a.h5", n=1)
    (tmp_path / "note.txt").write_text("mine")
    result = cli("export", *arguments)
    assert words in result.error()
    assert result.out == ""
    assert {p.name for p in tmp_path.iterdir()} == {"a.h5", "note.txt"}


def test_without_mujoco(cli, tmp_path, monkeypatch):
    make_shard(tmp_path / "a.h5", n=1)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert 'pip install "lgrasp[sim]"' in cli("export", "a.h5", "--to", "mjcf", "--out", "made").error()
    with pytest.raises(PhysicsError):
        export_shards([tmp_path / "a.h5"], tmp_path / "made", "mjcf", cut=pytest.fail)
    assert not (tmp_path / "made").exists()


def test_a_flat_object_is_refused_by_name(cli, tmp_path):
    flat = object_record()
    make_shard(
        tmp_path / "a.h5", n=1, objects=[replace(flat, vertices=flat.vertices * np.array([1, 1, 0], np.float32))]
    )
    line = cli("export", "a.h5", "--to", "mjcf", "--out", "made").error()
    assert "cup" in line
    assert "flat" in line
    assert not (tmp_path / "made").exists()


def test_interrupted(tmp_path):
    """Ctrl-C: exit code 130, every file whole, the export marked as not whole."""
    make_shard(tmp_path / "a.h5", n=20_000)
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


def test_an_interrupted_export_is_gone_on_with(cli, tmp_path, monkeypatch):
    """By the same command only; in the end it is as if nothing had happened."""
    make_shard(tmp_path / "a.h5", n=6)
    command = ("export", "a.h5", "--to", "dexgraspbench", "--out", "made")
    with monkeypatch.context() as patch:
        patch.setattr(JobProgress, "cancelled", lambda self: (tmp_path / "made").exists())
        assert cli(*command).code == 130
    left = tmp_path / "made" / "hand" / "hand.0123456789ab.urdf.tmp"
    left.touch()
    assert "made is not empty" in cli(*command, "--limit", 3).error()
    assert cli(*command).code == 0
    assert cli(*command[:-1], "whole").code == 0
    whole, made = (
        {path.relative_to(folder): path.is_file() and path.read_bytes() for path in folder.rglob("*")}
        for folder in (tmp_path / "whole", tmp_path / "made")
    )
    assert made == whole


def test_what_is_left_out_is_told_once(cli, tmp_path):
    (tmp_path / "grasps").mkdir()
    make_shard(tmp_path / "grasps" / "a.h5", n=3)
    two = [object_record(), object_record("jug", digit="2")]
    make_shard(tmp_path / "grasps" / "b.h5", objects=two, index=np.array([[0, 1], [1, 0]]), n=2)
    (tmp_path / "grasps" / "c.h5").write_text("no shard")
    result = cli("export", "grasps", "--to", "isaac-grasp", "--out", "made")
    assert result.code == 0, result
    assert "3 of 1 object" in result.out
    (line,) = result.err.splitlines()
    assert "2 of 3 files are left out" in line


def test_what_macos_leaves_beside_files_is_left_out(cli, tmp_path):
    for name in ("made/.DS_Store", "made/._hand", "._a.h5", "meshes/._a.obj"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(bytes(9))
    make_shard(tmp_path / "a.h5", n=3)
    assert cli("dataset", "check", ".").code == 0
    command = ("export", ".", "--to", "isaac-grasp", "--out", "made", "--licence", "MIT")
    assert cli(*command).code == 0
    assert "._" not in (tmp_path / "made" / "SHA256SUMS").read_text()
    for name in ("made/grasps/._cup.yaml", "made/hand/.DS_Store"):
        (tmp_path / name).touch()
    assert len(read_grasps(tmp_path / "made", "isaac-grasp").grasps) == 3
    assert cli(*command, "--overwrite").code == 0
    assert "'meshes' holds no mesh" in cli("generate", "--object", "meshes").error()


def test_an_export_that_is_replaced(cli, tmp_path):
    """--overwrite leaves nothing of the export before, and touches no file that is not of it."""
    first = make_shard(tmp_path / "a.h5", n=9)
    assert cli("export", "a.h5", "--to", "isaac-grasp", "--out", "made").code == 0
    make_shard(tmp_path / "a.h5", n=4, objects=[object_record("jug")])
    replacing = ("export", "a.h5", "--to", "graspgen", "--out", "made")
    assert cli(*replacing).code == 2
    (tmp_path / "made" / "notes.txt").write_text("mine")
    assert "made holds notes.txt, which is not of the export" in cli(*replacing, "--overwrite").error()
    assert len(read_grasps(tmp_path / "made", "isaac-grasp").grasps) == len(first.grasps)
    (tmp_path / "made" / "notes.txt").unlink()
    assert "none satisfies" in cli(*replacing, "--overwrite", "--where", "metrics/epsilon > 99").error()
    assert len(read_grasps(tmp_path / "made", "isaac-grasp").grasps) == len(first.grasps)
    assert cli(*replacing, "--overwrite").code == 0
    assert len(read_grasps(tmp_path / "made", "graspgen").grasps) == 4
    assert not [path for path in (tmp_path / "made").rglob("*") if "cup" in path.name or path.suffix == ".yaml"]
