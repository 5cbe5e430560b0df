"""What the benchmarks print sets like beside like."""

import sys
from pathlib import Path

import pytest

from lgrasp.bench import sequence
from lgrasp.bench.page import load_published
from lgrasp.bench.refine import STEPS, refine_page
from lgrasp.bench.sequence import bench_methods, sequence_page
from lgrasp.errors import PhysicsError


def plans(valid, seconds):
    each = {"starts": 48, "planned": 40, "valid": valid, "share": valid / 48, "epsilon": 0.1}
    return each | {"seconds": seconds, "seconds_each": seconds / valid}


@pytest.fixture
def refined():
    both = {"one": plans(24, 1.2), "best": plans(36, 18.0)}
    names = ("mesh", "cloud_0_mm", "cloud_2_mm", "cloud_5_mm", "cloud_10_mm")
    hand = {"planning": dict.fromkeys(names, both), "energy": [8.0, 4.0, 3.0, 2.0, 1.0], "milliseconds": [1.0] * 5}
    return {
        "device": "a machine",
        "objects": ["box"],
        "starts": 48,
        "protocol": "fc",
        "best_of": 30,
        "steps": list(STEPS),
        "published": load_published("dipgrasp").model_dump(mode="json"),
        "hands": {"barrett": hand | {"poses": 36}, "allegro": hand | {"poses": 36}},
    }


def test_paper_stands_beside_one_hand_a_start(refined):
    page = refine_page(refined)
    plan, energy, clouds = page.tables
    assert plan.rows == [
        ("barrett", "ours, one hand", "0.100", "50.0%", "0.05", "83.3%", "60.0%"),
        ("barrett", "paper", "0.201", "67.7%", "0.03", "-", "-"),
        ("barrett", "ours, best of 30", "0.100", "75.0%", "0.5", "83.3%", "90.0%"),
        ("allegro", "ours, one hand", "0.100", "50.0%", "0.05", "83.3%", "60.0%"),
        ("allegro", "ours, best of 30", "0.100", "75.0%", "0.5", "83.3%", "90.0%"),
    ]
    assert [row[1] for row in clouds.rows if row[0] == "barrett"] == ["ours, one hand", "paper", "ours, best of 30"]
    assert clouds.columns == ("hand", "whose", "0 mm", "2 mm", "5 mm", "10 mm", "kept", "s each")
    assert energy.rows[0][-2:] == ("8.0x", "1.0")
    assert any("one hand at each start" in line for line in page.notes)


def test_no_table_of_clouds_without_clouds(refined):
    for one in refined["hands"].values():
        one["planning"] = {"mesh": one["planning"]["mesh"]}
    assert len(refine_page(refined).tables) == 2


def entry(held, strict, seconds, begun=256):
    return {
        "begun": begun,
        "attempts": begun,
        "simulated": held,
        "strict": strict,
        "held": held,
        "success": 100 * held / begun,
        "success_of_attempts": 100 * held / begun,
        "success_of_simulated": 100.0,
        "consumed": 0.0,
        "penetration_mean": 0.5,
        "penetration_median": 0.4,
        "penetration_max": 0.8,
        "seconds": seconds,
        "seconds_per_256": 256 * seconds / begun,
        "held_per_s": held / seconds,
        "strict_per_s": strict / seconds,
        "diversity": None,
        "drawn_per_attempt": None,
        "passed": None,
    }


@pytest.fixture
def job():
    from lgrasp.engine.pipeline import load_pipeline
    from lgrasp.jobs.sequence.job import SequenceJob

    pipeline = load_pipeline("sequence").with_params("sequence", width=256)
    asked = {"hand": "allegro", "objects": ("mug", "box"), "rows": 1, "out": Path("."), "simulate": "seq6"}
    return SequenceJob(pipeline=pipeline, **asked)


@pytest.fixture
def sequences(job, monkeypatch):
    """bench_methods() of two methods whose measurements are given."""
    given = {
        "field": {"begun": 256, "spaces": {"thumb-palm": {"tried": 50, "found": 40, "held": 30}}},
        "anneal": {"begun": 32, "spaces": {}},
    }
    entries = {"field": entry(200, 200, 1.0), "anneal": entry(20, 2, 10.0, 32)}
    widths = {}

    def measured(job, device):
        params = job.pipeline.params("sequence")
        widths[params.method] = params.width
        return given[params.method] | {"objects": [entries[params.method]]}

    monkeypatch.setattr(type(job), "check_simulator", lambda job: None)
    monkeypatch.setattr(sequence, "measure_sequence", measured)
    monkeypatch.setattr(sequence, "summary", lambda parts: dict(parts[0]))
    *_, result = bench_methods([job], ["field", "anneal"], 32, lambda line: None)
    assert widths == {"field": 256, "anneal": 32}
    return result


def test_a_missing_simulator_is_told_before_anything_runs(job, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(PhysicsError, match=r"lgrasp\[sim\]"):
        next(bench_methods([job], ["field"], 32, pytest.fail))


def test_ratios_of_methods_by_held_and_by_strict_rows(sequences):
    assert sequences["methods"]["anneal"]["ratios"] == [{"held_per_s": 100.0, "strict_per_s": 1000.0}]
    rates = sequence_page(sequences).tables[-1]
    assert rates.rows[0] == ("1", "field", "200", "200", "", "")
    assert rates.rows[1] == ("1", "anneal", "2", "0.2", "100", "1,000")
    assert rates.rows[2][:3] == ("1", "published", "0.142")  # 256 attempts, 50.04 % of them hold, 900 s


def test_a_network_stands_beside_the_published_one(sequences):
    sequences["methods"]["diffuser"] = sequences["methods"]["field"]
    tables = sequence_page(sequences).tables
    assert tables[1].rows[0][6] == "78.1 % (50.0 %)"
    assert tables[-3].rows[0][6] == "78.1 % (47.0 %)"
    assert tables[-2].rows[0][1] == "0.50 (5.55)"


def test_published_shares_stand_beside_shares_of_all_attempts(sequences):
    spaces, shares, measures, *_ = sequence_page(sequences).tables
    assert spaces.rows == [("thumb-palm", "50", "40", "30", "60.0 %", "17.7 %", "75.0 %")]
    assert shares.columns[6:] == ("hold/begun", "hold/attempts", "hold/sim")
    assert shares.rows[0][6] == "78.1 % (50.0 %)"
    assert shares.rows[0][8] == "100.0 %"
    assert measures.columns[1:3] == ("penetration: mean mm", "median")
    assert measures.rows[0][1:3] == ("0.50 (1.73)", "0.40")
