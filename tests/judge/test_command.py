"""The command of the judge: what it prints, how it exits, that it stands alone, that bad files are one line."""

import json
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.jawshard import URDF, row, write_shard
from support.places import ROOT
from support.shards import sample_shard
from typer.testing import CliRunner

from lgrasp.dataset.writer import write_shard as save
from lgrasp.judge.bounds import JudgeError
from lgrasp.judge.checks import RowChecks
from lgrasp.judge.run import judge
from lgrasp.judge.shard import check_members
from lgrasp.runtime.kernels import import_all
from lgrasp_cli.main import app

ALONE = """
import sys

class Closed:
    def find_spec(self, name, path=None, target=None):
        inner = name.startswith("lgrasp.") and name.split(".")[1] != "judge"
        if inner or name.split(".")[0] in ("lgrasp_cli", "warp", "torch"):
            raise ModuleNotFoundError(f"{name} is closed to the judge")

sys.meta_path.insert(0, Closed())
sys.argv = ["judge", *sys.argv[1:]]
import runpy
runpy.run_module("lgrasp.judge", run_name="__main__")
"""


def run(*arguments: object):
    return CliRunner().invoke(app, ["judge", *map(str, arguments)])


def test_table_json_and_exit_code(tmp_path):
    write_shard(tmp_path / "good.h5", [row(), row(q=[0.025, 0.025, 0.5], follow=0.26)])
    result = run(tmp_path)
    assert result.exit_code == 0
    assert "good.h5       2       2  100.00 %  none" in result.stdout
    write_shard(tmp_path / "sub" / "bad.h5", [row(), row(pose=[0, 0, 0.005, 1, 0, 0, 0])])
    result = run(tmp_path, "--json", tmp_path / "out.json")
    assert result.exit_code == 1
    assert " sub/bad.h5 2 1 50.00 % penetration 1 (5, 2); made for profile plan" in " ".join(result.stdout.split())
    found = json.loads((tmp_path / "out.json").read_text())
    assert [s["valid_rows"] for s in found["shards"]] == [2, 1]
    assert found["shards"][1]["failures"] == {"penetration": {"rows": 1, "worst": pytest.approx(5.0), "bound": 2.0}}
    assert found["shards"][0]["claims"] == {"pipeline": "by hand", "profile": "plan"}
    assert run(tmp_path / "good.h5", "--quiet").stdout == ""
    refused = run(tmp_path / "good.h5", "--json", tmp_path)
    assert (refused.exit_code, refused.stdout) == (2, "")
    assert refused.stderr == f"error: file {tmp_path} cannot be written: it is a folder; name a file\n"


def test_without_coal_only_the_judge_is_missing(tmp_path, monkeypatch):
    write_shard(tmp_path / "good.h5", [row()])
    for name in [name for name in sys.modules if name.startswith("lgrasp.judge.") and not name.endswith(".bounds")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr(sys.modules["lgrasp.judge"], "run")
    monkeypatch.setitem(sys.modules, "coal", None)
    import_all()
    refused = run(tmp_path)
    assert (refused.exit_code, refused.stdout) == (2, "")
    installs = "the judge measures collisions between links with coal: pip install 'lgrasp[judge]'"
    assert refused.stderr == f"error: {installs}\n"


def test_rows_that_the_file_calls_invalid_count_apart(tmp_path):
    rows = [row(), row(pose=[0, 0, 0.005, 1, 0, 0, 0]), row(q=[0.025, 0.025, 0.5], follow=0.26)]
    path = write_shard(tmp_path / "kept.h5", rows, {"valid": ([1, 0, 0], "1")})
    result = run(path)
    assert result.exit_code == 0
    assert "kept as invalid: 2, of which 1 pass" in result.stdout
    assert "1 of 1 judged rows (100.00 %)" in result.stdout
    assert judge(path).valid.tolist() == [True, False, True]
    none = write_shard(tmp_path / "none.h5", rows[:1], {"valid": ([0], "1")})
    assert run(none).exit_code == 1  # nothing that the file stands for


def test_it_stands_alone(tmp_path):
    """With every other room closed, and the libraries of the product, the judge judges."""
    path = write_shard(tmp_path / "s.h5", [row()])
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    asked = [sys.executable, "-c", ALONE, str(path)]
    result = subprocess.run(asked, capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stderr
    assert "1 of 1 judged rows" in result.stdout


def test_each_file_is_judged_once(tmp_path):
    """Also one that two paths name; links to folders are followed, what macOS leaves beside files is left out."""
    path = write_shard(tmp_path / "data" / "a.h5", [row()])
    (path.parent / "._a.h5").write_bytes(bytes(9))
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "data").symlink_to(path.parent)
    (path.parent / "round").symlink_to(path.parent)
    assert len(judge([tmp_path / "linked", path, os.path.relpath(path)]).shards) == 1


def test_findings_go_where_they_are_asked(tmp_path):
    """Into new folders, through links and into pipes; nothing else is touched."""
    shard = write_shard(tmp_path / "good.h5", [row()])
    (tmp_path / "kept.json.tmp").write_text("mine")
    (tmp_path / "link.json").symlink_to(tmp_path / "kept.json")
    for name in ("link.json", "new/folder/out.json"):
        assert run(shard, "-q", "--json", tmp_path / name).exit_code == 0
        assert json.loads((tmp_path / name).read_text())["rows"] == 1
    assert (tmp_path / "link.json").resolve() == tmp_path / "kept.json"
    assert (tmp_path / "kept.json.tmp").read_text() == "mine"
    os.mkfifo(tmp_path / "pipe")
    end = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    assert run(shard, "-q", "--json", tmp_path / "pipe").exit_code == 0
    assert json.loads(os.read(end, 1 << 16))["rows"] == 1
    os.close(end)


def _damage(name):
    def change(path: Path) -> None:
        with h5py.File(path, "r+") as f:
            MENDS[name](f)

    return change


def _replace(f: h5py.File, name: str, value: object) -> None:
    del f[name]
    f[name] = value


def _huge(f: h5py.File) -> None:
    del f["grasps/q"]
    f.create_dataset("grasps/q", (1 << 40, 4), "f4", chunks=(4096, 4))


def _elsewhere(f: h5py.File) -> None:
    del f["grasps/q"]
    f.create_dataset("grasps/q", (1, 4), "f4", external=[("/dev/zero", 0, 16)])


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>'
MENDS = {
    "format": lambda f: f.attrs.__setitem__("format", "other"),
    "version": lambda f: f.attrs.__setitem__("format_version", "2.0"),
    "complete": lambda f: f.attrs.__setitem__("complete", 0),
    "no group grasps": lambda f: f.__delitem__("grasps"),
    "no dataset /grasps/contact_links": lambda f: f.__delitem__("grasps/contact_links"),
    "not numbers of shape": lambda f: _replace(f, "grasps/object_pose", np.zeros((1, 1, 6))),
    "/grasps/object_index": lambda f: _replace(f, "grasps/object_index", np.zeros((2, 1), "i4")),
    "larger than": _huge,
    "other files": _elsewhere,
    "no row": lambda f: [_replace(f, f"grasps/{k}", v[()][:0]) for k, v in list(f["grasps"].items())],
    "a mesh needs faces": lambda f: f["objects/a_cube/faces"].__setitem__((0, 0), 99),
    "point cloud": lambda f: _replace(f, "objects/a_cube/faces", np.zeros((0, 3), "i4")),
    "not XML": lambda f: _replace(f, "hand/urdf", "<robot"),
    "entities": lambda f: _replace(f, "hand/urdf", BOMB + URDF),
    "mimics itself": lambda f: _replace(f, "hand/urdf", URDF.replace('mimic joint="swing"', 'mimic joint="follow"')),
    "outside the tree": lambda f: _replace(f, "hand/urdf", URDF.replace('<parent link="tip"/>', '<parent link="x"/>')),
    "not movable": lambda f: _replace(f, "hand/joint_names", ["a", "b", "c", "d"]),
    "sizes are positive": lambda f: _replace(f, "hand/urdf", URDF.replace('radius="0.004"', 'radius="-1"')),
    "not in the shard": lambda f: f.__delitem__("hand/meshes"),
    "base link": lambda f: f["hand"].attrs.__setitem__("base_link", "arm"),
    "groups inside each other": lambda f: f.create_group("g" + "/g" * 60),
    "'hand/again' is a link to another group": lambda f: f.__setitem__("hand/again", f["hand"]),
    "text_sha256 differs": lambda f: f.attrs.__setitem__("text_sha256", "0" * 64),
}


@pytest.mark.parametrize("what", MENDS)
def test_files_that_cannot_be_judged(tmp_path, what):
    path = write_shard(tmp_path / "s.h5", [row()])
    _damage(what)(path)
    with pytest.raises(JudgeError, match=what) as caught:
        judge(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("member", ["hand", "hand/meshes/0", "objects/a_cube", "grasps/q", "statistics"])
def test_links_are_not_followed(tmp_path, member):
    """Neither to another file nor inside this one; members that the judge does not read must not be links either."""
    whole = write_shard(tmp_path / "whole.h5", [row()])
    for link in (h5py.ExternalLink(str(whole), f"/{member}"), h5py.SoftLink("/aside")):
        path = write_shard(tmp_path / "s.h5", [row()])
        with h5py.File(path, "r+") as f:
            if member in f:
                f.move(member, "aside")
            f[member] = link
        result = run(path)
        assert (result.exit_code, result.stdout) == (2, "")
        assert result.stderr == f"error: {path}: '{member}' is a link; a shard holds its own data\n"


def test_changed_texts_are_found(tmp_path):
    """A shard as lgrasp writes it keeps its checksum; with a changed attribute or URDF it is refused."""
    path = tmp_path / "s.h5"
    save(path, sample_shard(5, joints=4))
    with h5py.File(path) as f:
        check_members(f)
    for change in (
        lambda f: f["objects/cup"].attrs.__setitem__("scale", 2.0),
        lambda f: _replace(f, "hand/urdf", f["hand/urdf"].asstr()[()] + " "),
    ):
        save(path, sample_shard(5, joints=4))
        with h5py.File(path, "r+") as f:
            change(f)
        with pytest.raises(JudgeError, match="text_sha256 differs"):
            judge(path)


def test_no_shard_at_all(tmp_path):
    (tmp_path / "text.h5").write_text("no shard")
    (tmp_path / "empty.h5").touch()
    (tmp_path / "folder").mkdir()
    whole = write_shard(tmp_path / "s.h5", [row()]).read_bytes()
    (tmp_path / "half.h5").write_bytes(whole[: len(whole) // 2])
    for name in ("text.h5", "empty.h5", "half.h5", "folder", "missing.h5"):
        result = run(tmp_path / name)
        assert result.exit_code == 2, name
        assert result.stderr.startswith(f"error: {tmp_path / name}: ")
        assert result.stderr.count("\n") == 1
        assert not result.stdout
    assert run(tmp_path / "s.h5", "--rows", 0).exit_code == 2
    assert run(tmp_path / "s.h5", "--json", "/proc/no/out.json").exit_code == 2


def test_files_of_a_folder_that_cannot_be_judged_are_left_out(tmp_path, monkeypatch):
    """With one line, and exit code 2 whatever the verdict on the others; one that was named is an error."""

    def checks(shard, *args, **options):
        if shard.path.name == "late.h5":
            raise ValueError("numbers that no check expects")
        return RowChecks(shard, *args, **options)

    write_shard(tmp_path / "good.h5", [row()])
    (tmp_path / "gone.h5").symlink_to("nowhere")
    (tmp_path / "ring.h5").symlink_to("ring.h5")
    os.mkfifo(tmp_path / "pipe.h5")
    write_shard(tmp_path / "late.h5", [row()])
    monkeypatch.setattr(sys.modules["lgrasp.judge.run"], "RowChecks", checks)
    (tmp_path / "text.h5").write_text("no shard")
    result = run(tmp_path, "--json", tmp_path / "out.json")
    assert result.exit_code == 2
    assert "1 of 1 judged rows (100.00 %)" in result.stdout
    assert result.stderr.splitlines()[-1].startswith(
        f"warning: 5 of 6 files are left out, first {tmp_path / 'gone.h5'}: no such file"
    )
    assert result.stderr.count("\n") == 1
    found = json.loads((tmp_path / "out.json").read_text())
    assert (len(found["shards"]), len(found["left_out"])) == (1, 5)
    assert not judge(tmp_path).passed
    named = run(tmp_path, tmp_path / "text.h5")
    assert (named.exit_code, named.stdout) == (2, "")
    assert named.stderr.startswith(f"error: {tmp_path / 'text.h5'}: ")
    (tmp_path / "good.h5").rename(tmp_path / "late.h5")
    none = run(tmp_path)
    assert (none.exit_code, none.stdout) == (2, "")
    assert none.stderr.startswith(f"error: {tmp_path / 'gone.h5'}: no such file")
    write_shard(tmp_path / "late.h5", [row()])
    with h5py.File(tmp_path / "late.h5", "r+") as file:
        for name, column in [(name, column[:0]) for name, column in file["grasps"].items()]:
            del file["grasps"][name]
            file["grasps"][name] = column
    none = run(tmp_path)
    assert none.exit_code == 2
    assert none.stderr.startswith(f"error: no row in {tmp_path / 'late.h5'}; {tmp_path / 'gone.h5'}: no such file")


def test_damaged_string_heaps_are_found_before_they_are_read(tmp_path):
    path = write_shard(tmp_path / "s.h5", [row()])
    data = bytearray(path.read_bytes())
    heap = data.find(b"GCOL\x01\x00\x00\x00")
    data[heap + 24 : heap + 32] = (1 << 60).to_bytes(8, "little")
    path.write_bytes(data)
    with pytest.raises(JudgeError, match=f"string heap at byte {heap}"):
        judge(path)
