"""lgrasp dataset report on rows of several objects: numbers by objects in the hand and by opposition space."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from lgrasp.dataset.merge import merge_shards
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.report.write import read_dataset
from lgrasp.dataset.writer import write_shard
from lgrasp_cli.dataset import app

COUNTS = (30, 25, 12)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, make_sequence):
    """Two shards with verdicts of a protocol p, some of them not run."""
    folder = tmp_path_factory.mktemp("sequences") / "in"
    for index in range(2):
        shard = make_sequence(COUNTS, shard_index=index, seed=index)
        rng = np.random.default_rng(index)
        holds = rng.integers(-1, 2, sum(COUNTS)).astype("i1")
        touching = np.where(shard.grasps.object_index >= 0, 1, -1).astype("i1")  # a number per object
        physics, protocols = {"p_holds": holds, "p_touching": touching}, {"p_holds": "p", "p_touching": "p"}
        grasps = replace(shard.grasps, physics=physics, physics_protocols=protocols)
        write_shard(folder / f"{index}.h5", replace(shard, grasps=grasps))
    return folder


@pytest.fixture(scope="module")
def reported(folder):
    """The numbers of their report, the page, and what the command says."""
    page, numbers = folder.parent / "r.html", folder.parent / "r.json"
    done = CliRunner().invoke(app, ["report", str(folder), "--out", str(page), "--json", str(numbers)])
    return json.loads(numbers.read_text()), page.read_text(encoding="utf-8"), done.stdout


def test_numbers_are_those_of_the_rows(folder, reported, tmp_path):
    numbers, *_ = reported
    merge_shards(folder, tmp_path / "all.h5")
    grasps = read_shard(tmp_path / "all.h5").grasps
    count, holds = (grasps.object_index >= 0).sum(1), grasps.physics["p_holds"]
    (hand,) = numbers["hands"]
    assert {n: group["rows"] for n, group in hand["held"].items()} == {"1": 60, "2": 50, "3": 24}
    for n, group in hand["held"].items():
        mine = count == int(n)
        deep = 1e3 * grasps.metrics["penetration"][mine]
        assert group["penetration"]["max"] == pytest.approx(deep.max())
        assert group["penetration"]["over_bound"] == (deep > 2).sum()
        p = group["physics"]["p"]
        assert (p["run"], p["held"]) == ((holds[mine] >= 0).sum(), (holds[mine] == 1).sum())
        assert grasps.sequence is not None
        for number, name in enumerate(grasps.sequence.space_names):
            ours = mine & (grasps.sequence.space[:, int(n) - 1] == number)
            found = group["spaces"][name]
            assert found["rows"] == ours.sum()
            assert found["physics"]["p"]["held"] == (holds[ours] == 1).sum()
    whole, _ = read_dataset(tmp_path / "all.h5")
    assert whole["hands"][0]["held"] == hand["held"]


def test_page_has_the_tables(reported):
    _, text, _ = reported
    section = text[text.index("<h3>Objects in the hand</h3>") : text.index("<h3>Physics</h3>")]
    assert re.findall(r"as object (\d)", section) == ["1", "2", "3"]
    for words in ("<td>60</td>", "<td>24</td>", "finger 3", "hold (p)"):
        assert words in section
    assert "sets of objects in a hand" in text
    assert "cup + mug é" in text or "mug é + cup" in text


def test_every_object_of_a_set_has_its_line(reported):
    numbers, text, _ = reported
    section = text[text.index("<h3>Diversity</h3>") :]
    for group in numbers["hands"][0]["objects"]:
        if len(group["objects"]) > 1:
            for name, cover in group["coverage"].items():
                line = section[section.index(f"{' + '.join(group['objects'])}: {name}</td>") :]
                assert f"{cover['surface']['share']:.0%}" in line[: line.index("</tr>")]


def test_command_says_how_many_objects(reported):
    (line,) = (line for line in reported[2].splitlines() if line.startswith("objects in the hand"))
    assert line.split(maxsplit=4)[4] == "1: 60, 2: 50, 3: 24"


def test_sequences_beside_other_rows(tmp_path, make_shard, make_sequence):
    """Rows of several objects without steps, and of another hand's spaces, are counted where they belong."""
    write_shard(tmp_path / "a.h5", make_shard(9, objects=2, columns=2))
    write_shard(tmp_path / "b.h5", make_sequence((3, 2), joints=4))
    write_shard(tmp_path / "c.h5", make_sequence((4,), joints=4, spaces=2, shard_index=2))
    held = read_dataset(tmp_path)[0]["hands"][0]["held"]
    several = (read_shard(tmp_path / "a.h5").grasps.object_index >= 0).all(1).sum()
    assert held["2"]["rows"] == several + 2
    assert sum(space["rows"] for space in held["1"]["spaces"].values()) == 7
    assert sum(space["rows"] for space in held["2"]["spaces"].values()) == 2
