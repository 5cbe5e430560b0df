"""lgrasp dataset report: the page stands alone, and its numbers are those of the rows."""

import json
import re
import shutil
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from support.near import new_rows
from typer.testing import CliRunner

from lgrasp.dataset.merge import merge_shards
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.report.gather import NearRows
from lgrasp.dataset.report.write import read_dataset, report_dataset
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import OutputError, ShardError
from lgrasp.grasp.bounds import GraspBounds, measured_strictly
from lgrasp.jobs.row_counts import strict_rows
from lgrasp_cli.dataset import app

VOID = {"meta", "br", "link", "img", "hr", "input"}


class Balanced(HTMLParser):
    """Open elements, and every reference to something outside the page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open, self.outside, self.kinds = [], [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.kinds.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        self.handle_startendtag(tag, attrs)

    def handle_startendtag(self, tag, attrs):
        for name, value in attrs:
            inner = (value or "").startswith(("#", "data:", "url(#"))
            if name.partition(":")[2] == "href" or name in ("src", "href", "srcset", "action"):
                self.outside += [] if inner else [value]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def check_page(text: str) -> list[ET.Element]:
    """The charts of a page, which is whole and needs nothing else."""
    page = Balanced(text)
    assert page.open == []
    assert page.outside == []
    assert page.kinds.isdisjoint({"script", "link", "iframe", "object", "embed"})
    style = text[text.index("<style>") : text.index("</style>")]
    assert "@import" not in style
    assert "url(" not in style
    assert set(re.findall(r"https?://([^/\"' ]+)", text)) <= {"www.w3.org", "purl.org", "creativecommons.org"}
    assert "#010203" not in text
    charts = re.findall(r"<svg.*?</svg>", text, flags=re.DOTALL)
    return [ET.fromstring(chart) for chart in charts]


@pytest.fixture
def make(tmp_path):
    """make(paths): the numbers and the text of a report."""

    def make(*paths, out=tmp_path / "report.html", **more):
        numbers = report_dataset(paths, out, **more)
        json.dumps(numbers, allow_nan=False)
        return numbers, out.read_text(encoding="utf-8")

    return make


def test_generated_grasps(run, make, tmp_path, grasps, said):
    """Copies of shards are left out of all parts of the page."""
    run(rows=60, shard_rows=30)
    (tmp_path / "out" / "copy").mkdir()
    shutil.copy(next((tmp_path / "out").glob("*.h5")), tmp_path / "out" / "copy")
    seen = []
    numbers, text = make(tmp_path / "out", progress=lambda *now: seen.append(now))
    assert seen == [(30, 60), (60, 60)]
    assert "8 of 60 rows, evenly spread" in text
    assert text.count("data:image/jpeg;base64,") == 1
    titles = " ".join(" ".join(chart.itertext()) for chart in check_page(text))
    for words in ("penetration [mm]", "self_penetration [mm]", "normal_error [deg]", "epsilon", "x [mm]", "share [%]"):
        assert words in titles
    columns = grasps(tmp_path / "out")
    (hand,) = numbers["hands"]
    (group,) = hand["objects"]
    assert (numbers["rows"], numbers["shards"], hand["hand"], group["objects"]) == (60, 2, "allegro", ["mug"])
    for name, factor in (
        ("penetration", 1e3),
        ("gap", 1e3),
        ("normal_error", 180 / np.pi),
        ("epsilon", 1),
        ("gswo", 1),
    ):
        values = factor * columns[f"metrics/{name}"].astype(float)
        found = group["metrics"][name]
        assert found["max"] == pytest.approx(values.max())
        assert found["min"] == pytest.approx(values.min())
        # the median lies between the middle values, or within the cells' width of them
        low, high = np.sort(values)[[29, 30]]
        assert low * 0.97 - 1e-6 <= found["median"] <= high * 1.03 + 1e-6
    links = columns["contact_links"]
    count = np.bincount((links >= 0).sum((1, 2)))
    assert group["contacts"] == {str(n): int(c) for n, c in enumerate(count) if c}
    assert sum(hand["contact_links"].values()) == pytest.approx(1)
    names = read_shard(next((tmp_path / "out").glob("*.h5"))).hand.link_names
    top, share = next(iter(hand["contact_links"].items()))
    assert share == pytest.approx(max(np.bincount(links[links >= 0])) / (links >= 0).sum())
    assert names[int(np.bincount(links[links >= 0]).argmax())] == top
    assert group["distinct_poses"] == len(np.unique(columns["object_pose"][:, 0], axis=0))
    variance = np.linalg.svd(columns["q"] - columns["q"].mean(0), compute_uv=False) ** 2
    np.testing.assert_allclose(hand["posture"]["explained_variance"], variance / variance.sum(), atol=1e-6)
    run_ = hand["runs"][0]
    assert list(run_["survivors"]) == ["place", "domain", "ik", "search", "filter"]
    assert run_["survivors"]["filter"] >= 60
    assert group["physics"] == {}
    assert "<h3>Physics</h3>" not in text


def test_rows_are_counted_by_the_grasp_type_asked(make_shard, tmp_path):
    """All rows of a shard were asked for one; merging keeps it."""
    for i, steered in enumerate(
        ({"grasp_type": "tripod"}, {}, {"grasp_type": "palmar-pinch"}, {"grasp_type": "tripod"})
    ):
        shard = make_shard(3 + i, shard_index=i)
        config = {"steered": steered} if steered else {}
        write_shard(tmp_path / "in" / f"{i}.h5", replace(shard, header=replace(shard.header, config=config)))
    numbers, _ = read_dataset(tmp_path / "in")
    assert numbers["hands"][0]["grasp_types"] == {"": 4, "palmar-pinch": 5, "tripod": 9}
    merge_shards([tmp_path / "in" / f"{i}.h5" for i in (0, 3)], tmp_path / "all.h5")
    assert read_dataset(tmp_path / "all.h5")[0]["hands"][0]["grasp_types"] == {"tripod": 9}


def test_merged_rows_give_the_same_numbers(make_shard, tmp_path):
    """However rows are cut into shards."""
    for i in range(3):
        write_shard(tmp_path / "in" / f"{i}.h5", make_shard([40, 0, 7][i], objects=2, shard_index=i))
    merge_shards(tmp_path / "in", tmp_path / "all.h5")
    parts, _ = read_dataset(tmp_path / "in")
    whole, _ = read_dataset(tmp_path / "all.h5")
    a, b = parts["hands"][0], whole["hands"][0]
    for key in ("rows", "objects", "metrics", "contact_links", "sample"):
        assert a[key] == b[key]
    np.testing.assert_allclose(a["posture"]["explained_variance"], b["posture"]["explained_variance"], atol=1e-9)
    assert parts["remarks"] == ["No rows are in 1.h5."]
    both, _ = read_dataset([tmp_path / "in", tmp_path / "all.h5"])
    assert both["rows"] == 94
    assert "counted twice" in both["remarks"][0]
    assert both["hands"][0]["objects"][0]["near_duplicates"]["share"] == 0.5
    assert both["remarks"][1] == "No rows are in in/1.h5."


def test_no_row_of_a_higher_friction_is_below_the_bound(make_shard, tmp_path):
    """As in what generate counts: forces were balanced with that friction."""
    for i, friction in enumerate((0.5, 2.0)):
        shard = make_shard(4, shard_index=i)
        rows = replace(shard.grasps, metrics={name: np.full(4, 1e-4, "f4") for name in GraspBounds().limits})
        config = {"bounds": GraspBounds(friction=friction).describe()}
        assert strict_rows(lambda name, rows=rows: rows.columns()[name], config) == (4 if friction == 0.5 else 0)
        header = replace(shard.header, config=config)
        write_shard(tmp_path / f"{i}.h5", replace(shard, header=header, grasps=rows))
    numbers, _ = read_dataset(tmp_path)
    over = {name: found["over_bound"] for name, found in numbers["hands"][0]["metrics"].items()}
    assert over == {"penetration": 0, "gap": 0, "normal_error": 0, "gswo": 4}
    assert "above the strict 0.5 in 1.h5" in numbers["remarks"][0]
    assert measured_strictly({"bounds": "of another writer"})


def near_shard(make_shard, n, seed):
    """Rows around few centres, so that about half of them are near others."""
    shard = make_shard(n)
    random = np.random.default_rng(seed)
    centre = random.integers(0, n // 5, n)
    pose, q = shard.grasps.object_pose[centre].copy(), shard.grasps.q[centre]
    pose[:, 0, :3] += random.normal(0, 0.002, (n, 3))
    q = np.clip(q + random.normal(0, 0.04, q.shape), -1, 2).astype("f4")
    return replace(shard, grasps=replace(shard.grasps, object_pose=pose, q=q))


def test_near_duplicates(make_shard, tmp_path):
    shard = near_shard(make_shard, 300, 0)
    write_shard(tmp_path / "a.h5", shard)
    numbers, _ = read_dataset(tmp_path / "a.h5")
    near = numbers["hands"][0]["objects"][0]["near_duplicates"]
    dropped = 300 - int(new_rows(shard.grasps.object_pose[:, 0], shard.grasps.q).sum())
    assert 50 < dropped < 250
    assert (near["compared"], near["duplicates"], near["share"]) == (300, dropped, dropped / 300)


def test_poses_are_counted_once_wherever_their_rows_are():
    """Shards are shuffled: rows of one pose are in every block."""
    random = np.random.default_rng(0)
    poses = random.normal(size=(5_000, 1, 7)).astype(np.float32)
    rows, near = poses[random.integers(0, len(poses), 90_000)], NearRows(None)
    for block in np.array_split(rows, 7):
        near.add(block, block[:, 0])
    assert near.poses == len(np.unique(rows[:, 0], axis=0))


def test_several_objects_are_near_together(make_shard, tmp_path):
    """Both objects and the joints must be near; one that moved makes another grasp."""
    shard = make_shard(20, objects=2, columns=2)
    rows = shard.grasps
    pose = np.where(rows.object_index[..., None] < 0, np.nan, np.nan_to_num(rows.object_pose))
    pose = np.concatenate([pose, pose, pose]).astype("f4")
    pose[40:, 1, 0] += 0.02
    twice = {name: np.concatenate([v] * 3) for name, v in rows.columns().items() if "/" not in name}
    metrics = {name: np.concatenate([v] * 3) for name, v in rows.metrics.items()}
    tripled = replace(rows, **(twice | {"object_pose": pose}), metrics=metrics, physics={}, physics_protocols={})
    write_shard(tmp_path / "a.h5", replace(shard, grasps=tripled))
    numbers, _ = read_dataset(tmp_path / "a.h5")
    groups = {tuple(g["objects"]): g for g in numbers["hands"][0]["objects"]}
    assert len(groups) > 3
    for names, group in groups.items():
        assert group["near_duplicates"]["duplicates"] == group["rows"] * (1 if len(names) == 2 else 2) // 3
        assert set(group["coverage"]) == set(names)


def test_physics(make, make_shard, tmp_path):
    protocol = json.dumps({"name": "fc", "mass": 0.1})
    ways = np.tile(np.array([[1, 1, 1, 1, 1, 1], [1, 0, -1, -1, -1, -1], [0, 1, 1, 1, 1, 0]], "i1"), (10, 1))
    shard = make_shard(30)
    slip = np.array([0.5, 0.0, np.nan] * 10, "f4")
    physics = {"fc_holds": ways.min(1) == 1, "fc_directions": ways, "fc_slip": slip, "mine": slip}
    physics |= {"drop_holds": np.where(np.arange(30) < 20, 1.0, np.nan).astype("f4")}
    physics |= {"fc_slow_holds": np.ones(30, bool), "fc_slow_slip": np.ones(30, "f4")}  # fc is not fc_slow
    texts = dict.fromkeys(physics, protocol) | {"drop_holds": "from <1 m>"}
    write_shard(
        tmp_path / "a.h5", replace(shard, grasps=replace(shard.grasps, physics=physics, physics_protocols=texts))
    )
    without = make_shard(10, shard_index=1)
    write_shard(tmp_path / "b.h5", replace(without, grasps=replace(without.grasps, physics={}, physics_protocols={})))
    numbers, text = make(tmp_path)
    (group,) = numbers["hands"][0]["objects"]
    fc, drop = group["physics"]["fc"], group["physics"]["drop"]
    assert (fc["run"], fc["held"], fc["share"], fc["protocols"]) == (30, 10, 1 / 3, [json.loads(protocol)])
    assert fc["directions"]["+x"] == {"run": 30, "failed": 10}
    assert fc["directions"]["-x"] == {"run": 30, "failed": 10}
    assert fc["directions"]["-z"] == {"run": 20, "failed": 10}
    assert (drop["run"], drop["held"], drop["protocols"]) == (20, 20, ["from <1 m>"])
    assert "Failures by direction" in text
    assert "<td>33.3%</td>" in text
    assert "<td>100</td>" in text
    assert fc["means"] == {"slip": 0.25}
    assert "from &lt;1 m&gt;" in text
    check_page(text)


def test_hold_test(make, make_shard, tmp_path):
    """Its metrics are told as a verdict is."""
    shard = make_shard(30)
    share = np.linspace(0.0, 1.0, 30).astype("f4")
    metrics = {"hold_success": (share > 0.5).astype("f4"), "hold_probability": share, "hold_drift": np.full(30, 0.25)}
    metrics["hold_drift"][7] = np.inf  # no distance: left out
    held = replace(shard.grasps, metrics=shard.grasps.metrics | {k: v.astype("f4") for k, v in metrics.items()})
    held = replace(held, metric_units=held.metric_units | dict.fromkeys(metrics, "1"))
    write_shard(tmp_path / "a.h5", replace(shard, grasps=held))
    numbers, text = make(tmp_path)
    found = numbers["hands"][0]["objects"][0]["physics"]["hold_test"]
    assert (found["run"], found["held"], found["protocols"]) == (30, 15, [])
    assert found["means"] == pytest.approx({"probability": 0.5, "drift": 0.25})
    assert "<b>50.0%</b><span>hold in the hold test</span>" in text


def test_hands_and_names(make, make_shard, tmp_path):
    """Two hands in one folder, one name for two objects, and names that mean something to HTML and to charts."""
    one, two = make_shard(8, objects=2), make_shard(5, shard_index=1)
    odd = replace(one.objects[1], id="<b>&$x$_碗")
    scaled = replace(two.objects[0], scale=0.07)
    asked = replace(one.header, config={"steered": {"grasp_type": "tripod"}})
    write_shard(tmp_path / "a.h5", replace(one, header=asked, objects=[odd, one.objects[0]]))
    write_shard(tmp_path / "sub" / "a.h5", replace(two, hand=replace(two.hand, name="<other>", sha256="c" * 64)))
    write_shard(tmp_path / "b.h5", replace(two, objects=[scaled]))
    numbers, text = make(tmp_path)
    assert [hand["hand"] for hand in numbers["hands"]] == ["<other>", "toy"]
    names = {name for hand in numbers["hands"] for group in hand["objects"] for name in group["objects"]}
    assert names == {"<b>&$x$_碗", "cup (scale 0.05)", "cup (scale 0.07)"}
    assert "<b>&$" not in text
    assert "&lt;other&gt;" in text
    assert "none asked 5, tripod 8" in text
    assert any("<b>&$x$_碗" in "".join(chart.itertext()) for chart in check_page(text))


def test_rows_without_numbers(make, make_shard, tmp_path):
    """No row at all; no metric; a metric that was not measured; no contact."""
    empty = make_shard(0)
    write_shard(tmp_path / "a" / "0.h5", empty)
    numbers, text = make(tmp_path / "a")
    assert (numbers["rows"], numbers["hands"][0]["objects"]) == (0, [])
    assert "No rows are in 0.h5." in text
    assert check_page(text) == []
    shard = make_shard(6)
    metrics = {
        "penetration": np.full(6, np.nan, "f4"),
        "gap": np.array([np.nan] * 5 + [0.003], "f4"),
        "mine": np.ones(6),
    }
    blank = dict.fromkeys(("contact_points", "contact_normals", "contact_forces"), np.full((6, 1, 3, 3), np.nan))
    rows = replace(shard.grasps, metrics=metrics, contact_links=np.full((6, 1, 3), -1), **blank)
    write_shard(tmp_path / "b" / "0.h5", replace(shard, grasps=rows, statistics={}))
    numbers, text = make(tmp_path / "b")
    check_page(text)
    (group,) = numbers["hands"][0]["objects"]
    assert set(group["metrics"]) == {"gap"}
    gap = group["metrics"]["gap"]
    assert (gap["rows"], gap["missing"], gap["over_bound"]) == (1, 5, 1)
    assert gap["max"] == pytest.approx(3.0)
    assert '<td class="bad">3.00</td>' in text
    assert group["contacts"] == {"0": 6}


def test_what_cannot_be_done(make, make_shard, tmp_path):
    write_shard(tmp_path / "in" / "0.h5", make_shard(4))
    with pytest.raises(ShardError, match="no such file"):
        make(tmp_path / "none")
    with pytest.raises(OutputError, match="no regular file"):
        make(tmp_path / "in", out=tmp_path)
    data = (tmp_path / "in" / "0.h5").read_bytes()
    (tmp_path / "in" / "1.h5").write_bytes(data[:-100])
    with pytest.raises(ShardError, match=r"1\.h5"):
        make(tmp_path / "in" / "1.h5")
    assert not (tmp_path / "report.html").exists()


def test_command(make_shard, tmp_path):
    write_shard(tmp_path / "in" / "0.h5", make_shard(4))
    out, to_json = tmp_path / "page.html", tmp_path / "page.json"
    result = CliRunner().invoke(app, ["report", str(tmp_path / "in"), "-o", str(out), "--json", str(to_json)])
    assert result.exit_code == 0
    assert "4 in 1 shard," in result.stdout
    numbers = json.loads(to_json.read_text())
    held = numbers["hands"][0]["held"]["1"]
    assert (numbers["rows"], held["rows"], held["spaces"]) == (4, 4, {})
    text = out.read_text(encoding="utf-8")
    assert "Objects in the hand" not in text
    check_page(text)
    refused = CliRunner().invoke(app, ["report", str(tmp_path / "in"), "-o", str(tmp_path)])
    assert isinstance(refused.exception, OutputError)
