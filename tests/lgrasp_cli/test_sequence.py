"""``lgrasp sequence``: what goes wrong says so on one line; reports; configs of sets."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from lgrasp.object.find import find_object
from lgrasp.paths import data_dirs

PIPELINE = {
    "name": "small",
    "field": {"records": 20000},
    "stages": [
        {"place": {"max_com_distance": 0.02, "proposals": 1}},
        {"domain": {"attempts": 48, "keep": 4}},
        {"ik": {}},
        {"search": {"contacts": [2], "threshold": 0.15, "restarts": 16, "moves": 4, "per_pose": 1}},
        {"filter": {"draws": 1}},
    ],
    "sequence": {"width": 16, "wave": 64, "waves": 2},
}


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    path = tmp_path_factory.mktemp("pipeline") / "small.yaml"
    path.write_text(yaml.safe_dump(PIPELINE))
    return path


@pytest.fixture
def sequence(cli, small, tmp_path):
    def call(*arguments):
        return cli("sequence", *arguments, "-p", small, "--device", "cpu", "--out", tmp_path / "out")

    return call


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["mug"], "lgrasp generate --object"),
        (["mug", "shpere"], "shpere"),
        (["mug", "sphere", "--hand", "alegro"], "did you mean 'allegro'"),
        (["mug", "sphere", "--policy", "greedy"], "uniform"),
        (["mug", "sphere", "--method", "magic"], "anneal"),
        (["mug", "sphere", "--method", "diffuser"], "lgrasp sample MODEL"),
        (["mug", "sphere", "--scale", "0.1:0.05"], "0.06:0.10"),
        (["mug", "sphere", "--scale", "big"], "0.06:0.10"),
        (["mug", "sphere", "-n", "0"], "'rows' = 0: Input should be greater"),
        (["mug", "sphere", "--simulate", "fcc"], "seq6"),
        (["mug", "sphere", "--simulate", "dipgrasp"], "lifts one object alone; of several choose fc, "),
        (["mug", "sphere", "box", "capsule", "bowl", "--scale", "0.05:0.06"], "take at most 4"),
        (["mug", "sphere", "--array", "0/0"], "--array 0/0"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input(sequence, tmp_path, arguments, words):
    assert words in sequence(*arguments).error()
    assert not (tmp_path / "out").exists()


def test_pipeline_of_one_object(cli, tmp_path):
    assert "has no sequence" in cli("sequence", "mug", "sphere", "-p", "swift", "--out", tmp_path / "o").error()
    line = cli("generate", "--object", "tiny", "-p", "sequence", "--out", tmp_path / "o").error()
    assert "lgrasp sequence" in line


def test_hand_without_spaces(sequence, tmp_path):
    folder = next(p for p in data_dirs("hands") if (p / "allegro").is_dir()) / "allegro"
    spec = yaml.safe_load((folder / "hand.yaml").read_text())
    del spec["opposition_spaces"]
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "hand.yaml").write_text(yaml.safe_dump(spec))
    (bare / "hand.urdf").write_bytes((folder / "hand.urdf").read_bytes())
    assert "no opposition spaces" in sequence("mug", "sphere", "--hand", bare).error()


def test_object_that_no_space_can_hold(sequence, tmp_path):
    """A ball as large as the hand: which object, which spaces, and why."""
    line = sequence("sphere", "mug", "--scale", "0.4:0.4", "-n", "1", "-q").error(3)
    assert "object 1" in line
    assert "sphere" in line
    assert "400 x 400 x 400 mm" in line
    assert "stage place" in line
    for name in ("index-palm", "thumb-index", "middle-ring"):
        assert name in line.split("tried:")[1]
    assert not list(tmp_path.glob("out/*"))


def test_report(sequence, tmp_path):
    result = sequence("sphere", "mug", "-n", "6", "--scale", "0.06:0.08", "--json", tmp_path / "r.json")
    assert result.code == 0
    data = json.loads((tmp_path / "r.json").read_text())
    assert data["sequences"] == 6
    assert data["objects"] == ["sphere", "mug"]
    assert data["reached"][0] >= data["reached"][1] >= 6
    assert data["penetration"][1] < 2.0
    assert "6 of 6 requested" in result.out
    again = sequence("sphere", "mug", "-n", "6", "--scale", "0.06:0.08", "--verbose")
    assert "(6 already present)" in again.out
    assert "method field" in again.out


def test_sets(cli, small, tmp_path):
    config = tmp_path / "sets.yaml"
    sets = {"sets": 2, "length": 2, "permutations": 1, "scale": "0.06:0.08"}
    given = {"pipelines": [str(small)], "objects": ["sphere", "mug", "box"], "sequences": sets, "rows": 2}
    config.write_text(yaml.safe_dump(given | {"device": "cpu", "out": str(tmp_path / "sets")}))
    plan = cli("run", config, "--dry-run")
    assert len(plan.out.splitlines()) == 3
    parts = [cli("run", config, "--dry-run", "--array", f"{i}/2").out for i in (0, 1)]
    assert sorted(line for part in parts for line in part.splitlines()[1:]) == sorted(plan.out.splitlines()[1:])
    assert cli("run", config).code == 0
    assert len(list(Path(tmp_path / "sets").glob("*/*/*.h5"))) == 2


def test_no_set_has_an_object_that_is_held_out(cli, small, tmp_path):
    """Neither by name nor as a copy under another name, wherever it comes from."""
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    for name, source in {"cup": "mug", "ball": "sphere", "box": "box"}.items():
        shutil.copy(find_object(source), meshes / f"{name}.obj")
    config = tmp_path / "sets.yaml"
    sets = {"sets": 3, "length": 2, "permutations": 2}
    config.write_text(yaml.safe_dump({"pipelines": [str(small)], "sequences": sets, "out": "sets", "objects": ["mug"]}))
    pool = [f"--object={name}" for name in (meshes, "mug", "box", "bowl", "plate")]

    def drawn(*options):
        told = cli("run", config, *pool, *options, "--dry-run")
        files = [line.split()[-1] for line in told.out.splitlines()[1:]]
        return told, {name for file in files for name in Path(file).parts[1].split("-")[1:]}

    told, names = drawn("--held-out", "mug")
    assert "box: several objects of one name" in told.err
    assert names <= {"ball", "box", "bowl", "plate"}
    assert "2 objects make 1" in cli("run", config, *pool, "--held-out", meshes, "--dry-run").error()
    assert "mugg" in cli("run", config, *pool, "--held-out", "mugg", "--dry-run").error()


@pytest.mark.parametrize(
    ("sets", "words"),
    [({"sets": 4, "length": 2}, "3 objects make 3"), ({"sets": 1, "length": 2, "permutations": 3}, "have 2")],
)
def test_too_many_sets(cli, tmp_path, sets, words):
    config = tmp_path / "sets.yaml"
    config.write_text(yaml.safe_dump({"pipelines": ["sequence"], "objects": ["a", "b", "c"], "sequences": sets}))
    assert words in cli("run", config).error()


def test_sequences_are_drawn_with_a_seed():
    from lgrasp.jobs.sets import SequenceSets, object_sequences

    pool = [f"o{i}" for i in range(12)]
    sets = SequenceSets.model_validate({"sets": 20, "length": 4, "permutations": 3})
    drawn = object_sequences(pool, sets, 5)
    assert drawn == object_sequences(pool[::-1], sets, 5) != object_sequences(pool, sets, 6)
    assert len(set(drawn)) == 60
    groups = [frozenset(s) for s in drawn]
    assert len(set(groups)) == 20
    assert all(len(g) == 4 for g in groups)
    assert (np.unique(list(map(str, map(sorted, groups))), return_counts=True)[1] == 3).all()


def test_networks_that_cannot_be_used(cli, small):
    assert "absent.pt: no such file" in cli("sample", "absent.pt", "mug", "sphere").error()
    Path("bad.pt").write_bytes(b"nonsense")
    assert "bad.pt: not a network" in cli("sample", "bad.pt", "mug", "sphere", "--device", "cpu").error()
    assert "needs diffuser" in cli("sample", "seq-allegro", "mug", "sphere", "-p", small).error()
    assert (
        "--joint-steps is for --model coarse"
        in cli("learn", "fit", "--model", "diffuser", "out", "--joint-steps", 3).error()
    )
