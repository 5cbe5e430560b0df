"""``lgrasp scenes``: what it prints, its exit codes, one line for bad input."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml

from lgrasp.object.find import find_object

SMALL = {"objects": 2, "grasps": 5, "colliding": 5, "tested": 10, "camera": {"width": 80, "height": 60, "views": 2}}


@pytest.fixture
def config(tmp_path, quick):
    """config(**changes): file of a small config of scenes."""

    def write(**changes) -> Path:
        path = tmp_path / "small.yaml"
        data = {"hand": "allegro", "objects": ["tiny", "sphere"], "pipeline": quick, "stock": 10, "scenes": 2}
        data |= {"out": "out", "device": "cpu", "workers": 1, "scene": SMALL}
        path.write_text(yaml.safe_dump(data | changes))
        return path

    return write


def test_make_check_info(cli, config):
    made = cli("scenes", "make", config(), "--json", "report.json")
    assert made.code == 0, made
    assert "2 of 2 requested" in made.out
    data = json.loads(Path("report.json").read_text())
    assert data["made"] == 2
    assert set(data["objects"]) == {"sphere", "tiny"}
    again = cli("scenes", "make", config(), "-n", 3, "--json", "-")
    assert json.loads(again.out)["present"] == 2
    checked = cli("scenes", "check", "out")
    assert checked.code == 0
    assert checked.out == "3 scenes valid\n"
    assert "collision-free" in cli("scenes", "info", "out").out
    path = next(Path("out").glob("*.h5"))
    path.write_bytes(path.read_bytes()[:-50])
    broken = cli("scenes", "check", "out")
    assert broken.code == 2
    assert str(path) in broken.err


def test_a_dry_run_generates_no_grasps(cli, config):
    """Not even where scenes are there, whose key is that of the grasps."""
    assert cli("scenes", "make", config(job="scenes"), "-n", 1).code == 0
    before = {path: path.stat().st_mtime_ns for path in Path("out").rglob("*.h5")}
    plan = cli("run", config(job="scenes", stock=20), "--dry-run")
    assert plan.code == 0, plan
    assert [line.split()[2] for line in plan.out.splitlines()[1:]] == ["present", "missing"]
    assert {path: path.stat().st_mtime_ns for path in Path("out").rglob("*.h5")} == before


def test_options_replace_the_config(cli, config):
    result = cli("scenes", "make", config(), "--on-table", 1, "--views", 1, "-n", 1, "--out", "other", "--json", "-")
    data = json.loads(result.out)
    assert data["out"] == "other"
    assert sum(found["scenes"] for found in data["objects"].values()) == 1


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sceens": 3}, "unknown key 'sceens'; did you mean 'scenes'?"),
        ({"scene": {"camera": {"elevation": [80, 20]}}}, "the smaller number of a range comes first"),
        ({"scenes": 0}, "key 'scenes' = 0"),
        ({"scene": 5}, "key 'scene' = 5"),
        ({"hand": "nohand"}, "nohand"),
    ],
)
def test_bad_configs(cli, config, changes, words):
    assert words in cli("scenes", "make", config(**changes), "--on-table", 1).error()


def test_bad_options(cli, config):
    assert "no objects" in cli("scenes", "make").error()
    assert "unknown config of scenes" in cli("scenes", "make", "absent.yaml").error()
    assert "need 0 <= task < number" in cli("scenes", "make", config(), "--array", "3/2").error()
    assert "no such file" in cli("scenes", "check", "absent").error()
    Path("runs/a").mkdir(parents=True)
    Path("runs/a/shard.h5").touch()  # no folder of scenes
    assert cli("scenes", "info", "runs").error() == "error: no scene (*.h5) in runs"
    Path("file").write_text("")
    assert "is a file" in cli("scenes", "make", config(), "--out", "file/out").error()


def test_bad_objects(cli, generate, quick):
    """Said before grasps of the first object are made."""
    base = ("--pipeline", quick, "--stock", 5, "--device", "cpu", "--out", "scenes", "-n", 1, "--on-table", 1)

    def refused(*more):
        line = cli("scenes", "make", *more, *base).error()
        assert not Path("scenes").exists()
        return line

    assert "object 'nomug'" in refused("tiny", "nomug")
    Path("empty.obj").write_text("")
    assert "empty.obj: 0 bytes" in refused("tiny", "empty.obj")
    Path("tiny.obj").write_bytes(find_object("sphere").read_bytes())
    assert "have one name, 'tiny'" in refused("tiny", "./tiny.obj")
    Path("made").mkdir()
    Path("MADE").symlink_to("made")  # as on a disk that ignores case
    Path("Tiny.obj").write_bytes(Path("tiny.obj").read_bytes())
    same = cli("scenes", "make", "tiny", "Tiny.obj", *base, "--out", "made").error()
    assert "have one name, 'Tiny'" in same
    Path("a.yaml").write_text("scenes: 1")
    assert "the config a.yaml is named alone" in refused("a.yaml", "tiny")
    assert generate(rows=3).code == 0
    assert "out has no grasps of object 'sphere'; it has tiny" in refused("sphere", "--grasps", "out")
    assert "(hash " in refused("--grasps", "out", "--hand", "barrett")
    (path,) = Path("out").glob("*.h5")
    with h5py.File(path, "r+") as file:
        file["grasps/q"][1, 2] = np.nan
    assert f"{path}: q is not finite (row 1, 1 rows)" in refused("--grasps", "out")
