"""Benchmarks: what is handed from run to run, the arithmetic of the published table, and its picture."""

import json
from statistics import median

import pytest
from support.places import QUICK

from lgrasp.bench import comparison
from lgrasp.bench import rate as bench_module
from lgrasp.bench.charts import draw_table
from lgrasp.bench.comparison import (
    comparison_page,
    measure_table,
    new_table,
    read_table,
    trimmed_mean,
    with_ratios,
    without_missing,
)
from lgrasp.bench.page import Published, load_published
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.run import run
from lgrasp.errors import ConfigError, ObjectError, OutputError
from lgrasp.jobs.config import JobConfig, in_folder, load_config, plan_requests
from lgrasp.object.find import find_object
from lgrasp.picture.sheet import check_image

OBJECTS = ("capsule", "mug", "box")
PUBLISHED = Published(
    source="a paper", device="a GPU", figures={"allegro": {"capsule": 100.0, "mug": 400.0, "box": 10.0}}
)


@pytest.fixture
def runs(monkeypatch):
    """The jobs that a benchmark runs, with what came out."""
    seen = []

    def watched(job, **options):
        outcome = run(job, **options)
        seen.append((job, outcome))
        return outcome

    monkeypatch.setattr(bench_module, "run", watched)
    return seen


def test_yield_and_inputs_go_from_run_to_run(job, runs, known_hands, tmp_path):
    given = {"object": "tiny", "pipeline": load_pipeline(QUICK)}
    shared = comparison.Cache(tmp_path), {}
    results = bench_module.measure([job(**given, rows=20), job(**given, rows=10)], 2, *shared)
    count = len(runs)
    (later,) = bench_module.measure([job(**given, rows=5)], 1, *shared)
    trials = [(trial.rows, trial.rate) for trial, _ in runs[:count]]
    after = [outcome.job.measured_rate for _, outcome in runs[:count]]
    # two probes, then the jobs in turns; each begins with what the run before of the same job measured
    assert trials[:2] == [(2, 1.0), (1, 1.0)]
    assert trials[2:] == [(20, after[0]), (10, after[1]), (20, after[2]), (10, after[3])]
    assert all(0 < rate < 100 for rate in after)
    assert [r["grasps"] for r in results] == [20, 10]
    assert all(not trial.out.exists() for trial, _ in runs)
    # only the first run of all made object and field
    assert [all(outcome.job.inputs.hits.values()) for _, outcome in runs] == [False] + [True] * (len(runs) - 1)
    assert len(runs) > count
    assert later["build_seconds"] == results[0]["build_seconds"]
    assert results[0]["load_seconds"]["field"] < results[0]["build_seconds"]["field"]


@pytest.mark.parametrize(
    ("values", "mean"), [([3.0], 3.0), ([1.0, 3.0], 2.0), ([9.0, 2.0, 1.0], 2.0), ([1.0, 2.0, 4.0, 100.0], 3.0)]
)
def test_trimmed_mean(values, mean):
    assert trimmed_mean(values) == mean


def test_published_figures():
    config, published = load_config("table1"), load_published("lightning").figures
    assert tuple(published) == config.hands
    assert all(tuple(figures) == config.objects for figures in published.values())
    # what the paper prints below its columns
    means = {hand: round(trimmed_mean(list(row.values()))) for hand, row in published.items()}
    assert means == {"allegro": 1150, "leap": 420, "shadow": 559, "dclaw": 249}  # printed for allegro: 1091


@pytest.mark.parametrize("name", ["lightning", "seqgrasp", "dipgrasp"])
def test_published_figures_name_source_and_differences(name):
    published = load_published(name)
    assert published.source
    assert published.device
    assert published.differs


def test_unknown_published_figures():
    with pytest.raises(ConfigError, match=r"no published figures 'nobody'.*nobody\.yaml"):
        load_published("nobody")


def config(**changes):
    given = {"objects": OBJECTS, "pipelines": ("swift", "lightning"), "rows": 100, "device": "cpu"}
    return JobConfig(**given | changes)


def empty(chosen=None, repeat=3, baseline_rows=10):
    return new_table(chosen or config(), repeat=repeat, baseline_rows=baseline_rows, published=PUBLISHED)


def spread(*rates):
    return {"median": median(rates), "min": min(rates), "max": max(rates)}


def cell(mesh, swift, lightning, hand="allegro", error=""):
    one = {"swift": swift, "lightning": lightning}
    runs = {} if error else {name: {"strict_valid_per_s": spread(*rates)} for name, rates in one.items()}
    return {"hand": hand, "object": mesh, "error": error, "pipelines": runs}


RUN = {
    "grasps": 10,
    "strict": 10,
    "starved": False,
    "published_count_per_s": spread(1.0),
    "near_duplicates": 0,
    "distinct_poses": 5,
    "survivors": {"place": 3},
    "counts": {"place": {"kept": 3}},
    "seconds": {"place": 0.1, "wall": 0.2},
    "build_seconds": {"object": 1.0, "field": 2.0},
    "load_seconds": {"object": 0.1, "field": 0.2},
    "peak_rss_mb": 100.0,
}


@pytest.fixture
def table():
    """Three measured cells, in the wrong order."""
    cells = [cell("box", [10, 20, 90], [0]), cell("capsule", [300], [100]), cell("mug", [200], [50])]
    return with_ratios(empty() | {"cells": cells})


def test_ratios(table):
    capsule, mug, box = table["cells"]
    assert [c["object"] for c in table["cells"]] == list(OBJECTS)
    assert capsule["ratio"] == {"swift": 3.0}
    assert capsule["published_ratio"] == {"swift": 3.0, "lightning": 1.0}
    assert mug["published_ratio"]["swift"] == 0.5
    assert box["ratio"] == {"swift": None}  # nothing came out
    (mean,) = table["means"]
    assert mean["strict_valid_per_s"] == {"swift": 200.0, "lightning": 50.0}
    assert mean["ratio"] == {"swift": 4.0}
    assert mean["published_per_s"] == 100.0
    assert mean["published_ratio"]["swift"] == 2.0
    assert table["complete"]


def test_only_the_last_pipeline_is_the_baseline(job, monkeypatch):
    asked = []

    def watched(jobs, *how):
        asked.extend(job.rows for job in jobs)
        raise ConfigError("enough")

    monkeypatch.setattr(comparison, "measure", watched)
    chosen = config(objects=("tiny",), pipelines=("swift", "robust", "lightning"), rows=50)
    list(measure_table(empty(chosen, 1, 5), chosen, job().cache))
    assert asked == [50, 50, 5]


def test_page_sets_figures_beside_rates(table):
    cells = [c | {"pipelines": {name: RUN | run for name, run in c["pipelines"].items()}} for c in table["cells"]]
    page = comparison_page(table | {"cells": [c | {"hand_from": "allegro"} for c in cells]})
    rates = page.tables[0]
    assert rates.columns == (
        "object",
        "swift/s",
        "lightning/s",
        "swift/lightning",
        "published/s",
        "swift/published",
        "lightning/published",
    )
    assert rates.rows[0] == ("capsule", "300", "100", "3.0", "100", "3.0", "1.0")
    assert rates.rows[-1] == ("trimmed mean", "200", "50", "4.0", "100", "2.0", "0.5")
    assert any("a paper, on a GPU" in line for line in page.notes)


def test_ratios_without_published_figures(table):
    bare = with_ratios(table | {"published": None})
    assert {c["published_per_s"] for c in bare["cells"]} == {None}
    assert bare["means"][0]["published_ratio"] == {"swift": None, "lightning": None}
    some = table["published"] | {"figures": {"allegro": {"mug": 400.0}}}
    part = with_ratios(table | {"published": some})
    assert [c["published_ratio"]["swift"] for c in part["cells"]] == [None, 0.5, None]
    assert part["means"][0]["published_per_s"] is None  # of other cells it would compare nothing


def test_plot(table, tmp_path):
    for name, drawn in (("whole", table), ("bare", with_ratios(table | {"published": None}))):
        path = tmp_path / f"{name}.png"
        check_image(path, (".png",))
        draw_table(drawn, path)
        assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    lost = with_ratios(table | {"cells": [cell("box", [], [], error="no such mesh")]})
    draw_table(lost, tmp_path / "lost.png")
    assert (tmp_path / "lost.png").stat().st_size > 0
    with pytest.raises(OutputError, match=r"\.png"):
        check_image(tmp_path / "table.pdf", (".png",))


def test_resume_keeps_measured_cells(table, tmp_path):
    path = tmp_path / "table.json"
    wanted = empty()
    assert read_table(path, wanted) == wanted
    lost = cell("mug", [], [], error="it was away")
    path.write_text(json.dumps(with_ratios(table | {"cells": [table["cells"][0], lost]})))
    kept = read_table(path, wanted)
    assert kept["cells"] == table["cells"][:1]
    assert not kept["complete"]
    with pytest.raises(ConfigError, match="measured with rows 100, not 200"):
        read_table(path, empty(config(rows=200)))
    with pytest.raises(ConfigError, match="measured with objects"):
        read_table(path, empty(config(objects=("mug",))))
    path.write_text("[]")
    with pytest.raises(ConfigError, match="no table"):
        read_table(path, wanted)


def test_measured_cells_are_left_alone(table, job):
    assert list(measure_table(table, config(), job().cache)) == []


def test_cells_that_cannot_be_measured(job, known_hands):
    chosen = config(objects=("absent", "tiny"), pipelines=(QUICK,), rows=10)
    parts = list(measure_table(new_table(chosen, repeat=1, baseline_rows=1), chosen, job().cache))
    assert [len(table["cells"]) for table, _ in parts] == [1, 2]
    absent, tiny = parts[-1][0]["cells"]
    assert "absent" in absent["error"]
    assert not absent["pipelines"]
    assert not tiny["error"]
    assert tiny["pipelines"]["quick"]["grasps"] == 10
    assert parts[-1][0]["means"][0]["cells"] == 1


def test_names_must_differ():
    with pytest.raises(ConfigError, match="'mug' is named twice"):
        new_table(config(objects=("mug", "other/mug.obj")), repeat=1, baseline_rows=1)


def test_a_folder_stands_for_its_objects(tmp_path):
    for name in ("mug", "cup"):
        (tmp_path / f"{name}.stl").touch()
    assert new_table(config(objects=(str(tmp_path),)), repeat=1, baseline_rows=1)["objects"] == ["cup", "mug"]


def test_folders_come_first(tmp_path, job):
    (tmp_path / "allegro").mkdir()
    (tmp_path / "allegro" / "allegro.urdf").touch()
    (tmp_path / "mug.stl").touch()
    chosen = config(hands=("allegro", "leap"), hand_dir=tmp_path, object_dir=tmp_path, pipelines=("swift",))
    jobs = plan_requests(chosen)
    assert {j.values()["hand"] for j in jobs} == {str(tmp_path / "allegro" / "allegro.urdf"), "leap"}
    assert {j.values()["object"] for j in jobs} == {"capsule", str(tmp_path / "mug.stl"), "box"}
    assert in_folder(None, "mug") == in_folder(tmp_path / "none", "mug") == "mug"
    (tmp_path / "Big Cup.GLB").touch()
    assert in_folder(tmp_path, "Big Cup") == str(tmp_path / "Big Cup.GLB")
    for name, hint in (("Big Cap", "did you mean .*/Big Cup.GLB"), ("xyz", "holds Big Cup.GLB, mug.stl; named obj")):
        with pytest.raises(ObjectError, match=f"object '.*/{name}' is neither .*{hint}"):
            find_object(in_folder(tmp_path, name))
    kept, missing = without_missing(config(objects=("mug", "plier")))
    assert (kept.objects, missing) == (("mug",), ["plier"])
    with pytest.raises(ConfigError, match="hand_dir"):
        plan_requests(config(hand_dir=tmp_path / "none"))
