"""What a report counts of rows as they are made, and of those in files."""

from lgrasp.engine.report import job_report

_COUNTED = ("grasps", "strict", "distinct_poses", "published_count", "force_closure", "negatives", "resting")


def test_rows_in_memory_and_on_disk_count_alike(run, swift):
    made, read = (job_report(run(rows=40, pipeline=swift.with_table(), negatives=0.5)) for _ in range(2))
    assert (made["made"], read["made"]) == (40, 0)
    assert {name: made[name] for name in _COUNTED} == {name: read[name] for name in _COUNTED}
    assert (made["grasps"], made["negatives"], sum(pose["rows"] for pose in made["resting"])) == (40, 20, 40)
    assert 0 < made["distinct_poses"] <= 40
