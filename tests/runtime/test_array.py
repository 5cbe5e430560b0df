"""Job arrays: which shards a task makes, by what SLURM tells it, and when that is not enough."""

import pytest
from support.jobs import SampleJob

from lgrasp.engine.events import Events
from lgrasp.engine.run import run
from lgrasp.errors import ConfigError
from lgrasp.runtime.array import Array, SlurmArray, parse_array


def slurm(task: int, first: int, last: int, count: int, step: int = 1, **more: str) -> Array:
    """Task of an array as slurmctld 22.05 describes it: of a list the step is 1."""
    names = {"ID": task, "MIN": first, "MAX": last, "COUNT": count, "STEP": step}
    return parse_array("auto", {f"SLURM_ARRAY_TASK_{name}": str(value) for name, value in names.items()} | more)


class Words(Events):
    def __init__(self) -> None:
        self.lines: list[str] = []

    def said(self, words: str) -> None:
        self.lines.append(words)


def made(job: SampleJob, array: Array) -> list[int]:
    """Numbers of the shards that a task makes."""
    return [part.number for part, _ in run(job, array=array).made_parts]


def test_what_the_option_accepts():
    assert parse_array("auto", {}) == parse_array("off", {"SLURM_ARRAY_TASK_ID": "3"}) == Array(0, 1)
    assert parse_array("3/10") == Array(3, 10)
    for text in ("10/10", "0/0", "3", "1/x", "-1/2", "3/10/2", "", "AUTO"):
        with pytest.raises(ConfigError, match=f"--array '?{text}"):
            parse_array(text)
    with pytest.raises(ConfigError, match="SLURM_ARRAY_TASK_COUNT is not set; give --array"):
        parse_array("auto", {f"SLURM_ARRAY_TASK_{name}": "3" for name in ("ID", "MIN", "MAX", "STEP")})
    with pytest.raises(ConfigError, match=r"SLURM_ARRAY_TASK_ID=x, SLURM_.*=x: whole numbers .* give --array"):
        parse_array("auto", {f"SLURM_ARRAY_TASK_{name}": "x" for name in ("ID", "MIN", "MAX", "STEP", "COUNT")})
    with pytest.raises(ConfigError, match="SLURM_ARRAY_TASK_ID=x: whole numbers"):
        parse_array("auto", {"SLURM_ARRAY_TASK_ID": "x"})


@pytest.mark.parametrize(
    ("array", "numbers"),
    [
        (slurm(0, 0, 2, 3), (0, 3)),
        (slurm(3, 1, 3, 3), (2, 3)),
        (slurm(6, 0, 9, 4, step=3), (2, 4)),
        (slurm(18, 17, 19, 3), (1, 3)),
    ],
)
def test_ranges(array, numbers):
    assert array.resolved()[:2] == numbers


def test_a_submitted_script_knows_the_whole_array():
    """Of tasks that are submitted again, also where no manifest tells, as of shards that get more columns."""
    for task in (1, 3):
        assert slurm(task, 1, 3, 2, LGRASP_ARRAY="0-3").resolved()[:2] == (task, 4)
    assert slurm(2, 2, 3, 2, LGRASP_ARRAY="0-3").resolved()[:2] == (2, 4)
    assert slurm(1, 0, 3, 4, LGRASP_ARRAY="0-3").resolved()[:2] == (1, 4)
    with pytest.raises(ConfigError, match="this folder knows nothing"):
        slurm(1, 1, 3, 2, LGRASP_ARRAY="nonsense").resolved()


def test_lanes_share_what_a_task_has():
    """Of several jobs too, each of one part: no device waits for the others."""
    tasks = [Array(task, 3, lane=lane, lanes=2) for task in range(3) for lane in range(2)]
    assert sorted(n for array in tasks for n in array.share(range(20))) == list(range(20))
    assert tasks[2].share(range(20)) == [1, 7, 13, 19]
    lanes = [[Array(lane=lane, lanes=2, before=job, total=4).share(["x"]) for job in range(4)] for lane in range(2)]
    assert lanes == [[["x"], [], ["x"], []], [[], ["x"], [], ["x"]]]


@pytest.mark.parametrize("array", [slurm(17, 17, 23, 2), slurm(7, 3, 9, 3), slurm(2, 0, 6, 4)])
def test_a_list_alone_does_not_say_how_many_tasks_there_are(array):
    with pytest.raises(ConfigError, match=rf"--array {array.slurm.task}/N, or --array off"):
        array.resolved()


@pytest.mark.parametrize(
    ("array", "begun", "numbers"),
    [
        (slurm(23, 17, 23, 2), "0-99", (23, 100)),
        (slurm(17, 17, 17, 1), "0-99", (17, 100)),
        (slurm(0, 0, 0, 1), "0-99", (0, 100)),
        (slurm(18, 17, 19, 3), "1-100", (17, 100)),
        (slurm(9, 3, 9, 2), "0-9:3", (3, 4)),
        (slurm(3, 0, 9, 10), "0-99", (3, 10)),  # fewer tasks for everything
        (slurm(3, 0, 99, 100), "0-9", (3, 100)),  # more
        (slurm(3, 0, 9, 10), "0-9", (3, 10)),
        (slurm(3, 0, 9, 10), "anything", (3, 10)),
    ],
)
def test_tasks_that_are_submitted_again_are_those_of_the_first_array(array, begun, numbers):
    assert array.resolved(begun)[:2] == numbers


def test_a_list_makes_the_shards_of_its_tasks(tmp_path):
    """Ten tasks began; two of them failed and are submitted as --array=3,7."""
    job, words = SampleJob(out=tmp_path, rows=20), Words()
    for task in (0, 5):
        assert made(job, slurm(task, 0, 9, 10)) == [task]
    outcome = run(job.changed(), words, array=slurm(7, 3, 7, 2))
    assert [part.number for part, _ in outcome.made_parts] == [7]
    assert words.lines == ["array task 7 of 10 (of array 0-9, which began the run): shard 7"]
    assert made(job.changed(), slurm(3, 3, 7, 2)) == [3]
    assert made(job.changed(rows=60), slurm(3, 3, 7, 2)) == [13, 23]
    run(job.changed(rows=60))
    again = run(job.changed(rows=60), array=slurm(7, 3, 7, 2))
    assert [path.name[-8:-3] for path in again.paths] == ["00007", "00017", "00027"]


def test_the_first_line(tmp_path):
    words = Words()
    run(SampleJob(out=tmp_path, rows=40), words, array=slurm(1, 0, 2, 3))
    run(SampleJob(out=tmp_path, rows=40), words, array=Array(19, 30))
    run(SampleJob(out=tmp_path, rows=40), words, array=Array(25, 30))
    run(SampleJob(out=tmp_path, rows=40), words)
    assert words.lines == [
        "array task 1 of 3: shards 1, 4, 7, 10, 13, ...",
        "array task 19 of 30: shard 19",
        "array task 25 of 30: no shard",
    ]


@pytest.mark.parametrize("task", [0, 3])
def test_more_tasks_than_shards(tmp_path, task):
    """One object a task: without a word nine of ten would make nothing."""
    job = SampleJob(out=tmp_path, rows=2)
    with pytest.raises(ConfigError, match=rf"^array task {task} of 10: there is 1 shard .*--array off .*{task}/10"):
        run(job, array=slurm(task, 0, 9, 10))
    assert list(tmp_path.iterdir()) == []
    assert made(job.changed(), parse_array("off")) == [0]


def test_several_jobs_are_shared_like_one(tmp_path):
    """Two, one and three parts: every task of six has one of them."""
    jobs = [SampleJob(out=tmp_path, rows=rows) for rows in (4, 2, 6)]
    parts = [job.parts() for job in jobs]
    for task in range(6):
        array = Array(task, 6, slurm=SlurmArray(task, 0, 5, 1, 6), total=6)
        own = [array._replace(before=before).share(p) for before, p in zip((0, 2, 3), parts, strict=True)]
        assert sum(map(len, own)) == 1
    with pytest.raises(ConfigError, match="there are 6 parts to share"):
        Array(0, 7, slurm=SlurmArray(0, 0, 6, 1, 7), total=6).share(parts[0])
