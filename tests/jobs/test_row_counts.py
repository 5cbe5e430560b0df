"""What a report counts of rows as they are made, and of those in files."""

from dataclasses import replace

from lgrasp.engine.events import JobOutcome
from lgrasp.engine.report import job_report
from lgrasp.jobs.bottleneck import starving_stage
from lgrasp.jobs.generate import GenerateJob
from lgrasp.runtime.device import resolve_device

_COUNTED = ("grasps", "strict", "distinct_poses", "published_count", "force_closure", "negatives", "resting")


def test_rows_in_memory_and_on_disk_count_alike(run, swift):
    made, read = (job_report(run(rows=40, pipeline=swift.with_table(), negatives=0.5)) for _ in range(2))
    assert (made["made"], read["made"]) == (40, 0)
    assert {name: made[name] for name in _COUNTED} == {name: read[name] for name in _COUNTED}
    assert (made["grasps"], made["negatives"], sum(pose["rows"] for pose in made["resting"])) == (40, 20, 40)
    assert 0 < made["distinct_poses"] <= 40


def test_what_stops_a_job_is_told(small_job, tmp_path, monkeypatch):
    """Few rows that pass, or few that are no near-duplicates of others."""
    job = GenerateJob(**small_job | {"out": tmp_path})
    few = JobOutcome(job, resolve_device("cpu"), parts=[], on_disk={0: 20}, starved=True)
    for passed, words in ((30, "stage filter is the bottleneck"), (500, "of 500 that passed, the others are near-")):
        counts = {"place": {"tried": 9, "kept": 9}, "filter": {"kept": passed, "contact": 2 * passed}}
        monkeypatch.setattr(GenerateJob, "report", lambda *_, counts=counts: {"counts": counts})
        said = str(job.shortfall(few))
        assert said.startswith("20 of 60 grasps found; ")
        assert words in said
    assert "steer" not in said
    steered = GenerateJob(**small_job | {"out": tmp_path, "pipeline": job.pipeline.with_steering(palm="no")})
    counts = {"place": {"tried": 9, "kept": 9}, "filter": {"kept": 30, "contact": 60}}
    monkeypatch.setattr(GenerateJob, "report", lambda *_: {"counts": counts})
    assert "what is asked (steer.palm) may leave few" in str(steered.shortfall(replace(few, job=steered)))


def test_a_stage_that_nothing_reached_is_not_blamed():
    counts = {"place": {"tried": 9, "kept": 9}, "adjust": {"tried": 5, "kept": 0}, "filter": {"kept": 0, "contact": 0}}
    assert starving_stage(counts)[0] == "adjust"


def test_a_stage_that_few_reached_is_not_blamed():
    """Real barrett with a screwdriver on a table; then ten that reached the filter, which does tell."""
    few = {"ik": {"tried": 30_000, "kept": 17_530}, "search": {"poses": 5_000, "yielding": 1}}
    assert starving_stage(few | {"filter": {"kept": 0, "table": 1}})[0] == "search"
    some = {"search": {"poses": 50, "yielding": 10}, "filter": {"kept": 0, "table": 10}}
    assert starving_stage(some)[0] == "filter"


def test_the_reason_of_most_lost_grasps_is_told():
    for lost, words in (
        ("contact", "bounds.max_gap"),
        ("unresisted load", "bounds.max_unresisted_load"),
        ("", "collide"),
    ):
        counts = {"filter": {"kept": 1, "object collision": 5, lost or "self-collision": 20 if lost else 3}}
        assert words in starving_stage(counts)[1]
