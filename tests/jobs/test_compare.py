"""lgrasp hands compare: numbers of its shards, variants as hands of their own, the page, requests that cannot be."""

import json
import re

import pytest
import trimesh
from support.places import QUICK

from lgrasp.dataset.reader import ShardReader
from lgrasp.dataset.validate import validate_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.report import job_report
from lgrasp.engine.run import run
from lgrasp.errors import ConfigError, HandError
from lgrasp.jobs.compare.job import CompareJob
from lgrasp.jobs.requests.compare import CompareRequest, parse_variations

ROWS = 4


@pytest.fixture(scope="module")
def tasks(cache_root, tmp_path_factory):
    """The reports of two tasks, one after the other, which share a hand and a variant on one object; the folder."""
    out = tmp_path_factory.mktemp("compare")
    given = {
        "hands": ("barrett",),
        "objects": ("sphere",),
        "vary": ("link_scale:1.1",),
        "rows": ROWS,
        "pipeline": QUICK,
    }
    job = CompareJob(**given, out=out, device="cpu", workers=1, cache=Cache(cache_root))
    return [job_report(run(job.changed(), array=(task, 2))) for task in range(2)], out


@pytest.fixture(scope="module")
def compared(tasks):
    """The report of both, and the folder."""
    (_, data), out = tasks
    return data, out


def test_numbers_are_those_of_the_shards(compared):
    data, out = compared
    assert json.loads(json.dumps(data)) == data
    assert [(hand["hand"], hand["of"], hand["variation"]) for hand in data["hands"]] == [
        ("barrett", "barrett", None),
        ("barrett-link_scale-1.1", "barrett", "link_scale-1.1"),
    ]
    for hand in data["hands"]:
        (path,) = (out / f"{hand['hand']}-sphere").rglob("*.h5")
        assert validate_shard(path) == []
        cell = hand["objects"]["sphere"]
        with ShardReader(path) as reader:
            assert cell["rows"] == len(reader) == ROWS
            assert cell["hold"] > 0
            assert cell["hold"] == pytest.approx(reader.column("metrics/hold_success").mean())
            assert cell["epsilon"] == pytest.approx(float(reader.column("metrics/epsilon").mean()), rel=1e-5)
            kept, tried = (float(reader.statistics[name]) for name in ("filter_kept", "candidates"))
            assert cell["yield"] == pytest.approx(kept / tried)  # all rows are strict
        assert 0 < cell["surface"] < 1
        assert 0 < cell["approach"] <= ROWS / 288
        assert hand["all"]["yield"] == cell["yield"]  # the mean over one object
        assert hand["all"]["pca_ratio"] == cell["pca_ratio"]
    small, large = (hand["workspace"] for hand in data["hands"])
    assert large["manipulability"] == pytest.approx(1.1**3 * small["manipulability"], rel=1e-3)
    assert large["volume"] > small["volume"]
    assert [len(hand["grasp_types"]) for hand in data["hands"]] == [10, 10]


def test_page_stands_alone(compared):
    data, out = compared
    assert data["page"] == str(out / "compare.html")
    text = (out / "compare.html").read_text(encoding="utf-8")
    assert text.count("data:image/jpeg;base64,") == 2
    assert "barrett-link_scale-1.1" in text
    assert "<script" not in text
    assert not re.search(r'(src|href)="(?!data:)', text)


def test_a_task_reports_what_is_there(tasks):
    (first, second), _ = tasks
    assert [(data["missing"], [hand["hand"] for hand in data["hands"]]) for data in (first, second)] == [
        (1, ["barrett"]),
        (0, ["barrett", "barrett-link_scale-1.1"]),
    ]


def test_pairs_with_few_grasps_are_named(cache_root, tmp_path):
    """The ball is too large for the hand."""
    trimesh.creation.icosphere(3, 0.2).export(tmp_path / "moon.obj")
    pool = {"hands": ("barrett",), "objects": (str(tmp_path / "moon.obj"),), "rows": ROWS}
    job = CompareJob(**pool, pipeline=QUICK, out=tmp_path / "out", device="cpu", workers=1, cache=Cache(cache_root))
    data = job_report(outcome := run(job))
    error = job.shortfall(outcome)
    assert error is not None
    assert error.exit_code == 3
    assert "fewer than 4 grasps: barrett with moon 0;" in str(error)
    assert data["short"] == [{"hand": "barrett", "object": "moon", "rows": 0}]
    assert data["hands"][0]["all"]["hold"] is None
    assert "leave out objects without a grasp" in (tmp_path / "out/compare.html").read_text()


def test_variations():
    found = parse_variations(["joint_limit:+-20% link_scale:0.8,1.2", "joint_limit:±20%,+50%", "finger_spacing:-10%"])
    assert [variation.label for variation in found] == [
        "joint_limit-0.8",
        "joint_limit-1.2",
        "link_scale-0.8",
        "link_scale-1.2",
        "joint_limit-1.5",
        "finger_spacing-0.9",
    ]
    for text in ("link_scale:1", "link_scale:20%", "link_scale:+0.2", "link_scale:", "link_scale:9", "link_scale:a"):
        with pytest.raises(ConfigError, match=r"value .* is not accepted; give factors from 0.2 to 5 other than 1"):
            parse_variations([text])
    with pytest.raises(ConfigError, match="did you mean 'link_scale'"):
        parse_variations(["link_scal:2"])


def test_what_cannot_be_asked(tmp_path):
    with pytest.raises(HandError, match="unknown hand 'alegro'"):
        CompareRequest(hands=("alegro",), out=tmp_path).check()
    with pytest.raises(ConfigError, match="is for several objects"):
        CompareRequest(hands=("allegro",), out=tmp_path, pipeline="sequence").check()
