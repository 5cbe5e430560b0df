"""What all jobs share: array tasks make the files of a single run, a cut run goes on, a stop leaves whole files."""

import json
import re
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support.sequences import OBJECTS, small_pipeline
from support.urdfs import arm

from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import Events, JobOutcome
from lgrasp.engine.report import job_report
from lgrasp.engine.run import Job, run
from lgrasp.engine.run import run as generate
from lgrasp.jobs.export import ExportJob
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.learn.job import FitJob, load_predictor
from lgrasp.jobs.metrics import MetricsJob
from lgrasp.jobs.reach import ReachJob
from lgrasp.jobs.refine.plan import PlanJob
from lgrasp.jobs.refine.shards import RefineJob
from lgrasp.jobs.scenes.job import SceneJob
from lgrasp.jobs.sequence.job import SequenceJob
from lgrasp.jobs.simulate import SimulateJob
from lgrasp.learn.params import LearnParams
from lgrasp.planning.params import PlanParams
from lgrasp.reach.placement import Placement
from lgrasp.simulate.protocol import find_protocol
from lgrasp.stages.refine.params import RefineParams
from lgrasp_cli.progress import Bar, JobProgress

NAMES = (
    "generate",
    "sequence",
    "refine",
    "plan",
    "simulate",
    "reach",
    "scenes",
    "learn",
    "metrics",
    "export",
)


@pytest.fixture(scope="module")
def shards(small_job, tmp_path_factory: pytest.TempPathFactory) -> Callable[[int, int], Path]:
    """shards(rows, shard_rows): a folder of grasps of a ball, which physics takes as it is."""

    @cache
    def shards(rows: int, shard_rows: int) -> Path:
        out = tmp_path_factory.mktemp("source")
        changes = {"object": "sphere", "rows": rows, "shard_rows": shard_rows, "out": out}
        generate(GenerateJob(**small_job | changes))
        return out

    return shards


@pytest.fixture(scope="module")
def source(shards) -> Path:
    """Two shards of three grasps."""
    return shards(6, 3)


@pytest.fixture(scope="module")
def jobs(swift, source: Path, shards, cache_root: Path) -> Callable[[str, Path], Job]:
    """jobs(name, out): a small job of each kind."""

    def make(name: str, out: Path) -> Job:
        base: dict[str, Any] = {"out": out, "device": "cpu", "workers": 1, "cache": Cache(cache_root)}
        made: dict[str, Any] = base | {"shards": (source,)}
        if name == "simulate":
            pytest.importorskip("mujoco")
            return SimulateJob(**made, protocol=find_protocol("fc"))
        if name == "reach":
            made["arm"] = arm(source.parent)
            return ReachJob(**made, at=Placement(position=(0.4, 0.0, 0.3)), tries=4)
        if name == "generate":
            return GenerateJob(**base, object="mug", rows=8, shard_rows=4, batch=128, pipeline=swift)
        if name == "sequence":
            given = base | {"objects": OBJECTS, "scale": "0.06:0.08", "rows": 2, "shard_rows": 1}
            return SequenceJob(**given, pipeline=small_pipeline(width=12, waves=2))
        if name == "scenes":
            pytest.importorskip("mujoco")
            scene = {"objects": 1, "grasps": 4, "colliding": 2, "camera": {"views": 1, "width": 64, "height": 48}}
            return SceneJob.model_validate(base | {"grasps": source, "scenes": 2, "scene": scene})
        if name == "learn":
            small = {"points": 32, "width": 8, "clouds": 2, "held_out": 1, "batch": 4, "steps": 3, "joint_steps": 1}
            params = LearnParams.model_validate(small | {"unrolled": 1})
            return FitJob(**made | {"shards": (shards(18, 18),), "out": out / "coarse.pt"}, params=params)
        if name == "plan":
            return PlanJob(**base, hand="barrett", object="sphere", starts=2, params=PlanParams(rolls=8, finalists=2))
        if name == "export":
            return ExportJob(**made, to="dexgraspnet")
        if name == "refine":
            return RefineJob(**made, params=RefineParams(matching_rounds=1))
        return MetricsJob(**made, add=("volume",))

    return make


def contents(folder: Path) -> dict[str, dict[str, bytes] | bytes]:
    """What every file holds: rows of shards and scenes, weights of predictors, bytes of others."""
    found: dict[str, dict[str, bytes] | bytes] = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        name = path.relative_to(folder).as_posix()
        if path.suffix == ".pt":
            weights = load_predictor(path)[0].state_dict()
            found[name] = {key: values.numpy().tobytes() for key, values in weights.items()}
            continue
        if path.name == "manifest.json":  # seconds and times in a shard change its bytes
            found[name] = re.sub(rb'"(bytes|sha256)": [^\n]*', b"", path.read_bytes())
            continue
        if path.suffix != ".h5":
            found[name] = path.read_bytes()
            continue
        rows: dict[str, bytes] = {}

        def visit(key: str, node: object, rows: dict[str, bytes] = rows) -> None:
            if isinstance(node, h5py.Dataset):
                rows[key] = np.asarray(node).tobytes()

        with h5py.File(path) as file:
            file["grasps"].visititems(visit)
        found[name] = rows
    return found


class Stop(Events):
    """Stops the job before its first part."""

    def cancelled(self) -> bool:
        return True


class Shown(Bar):
    """The last that a bar showed: done, of all."""

    last = (0, 0)

    def show(self, what, done=None, total=0, *more):
        self.last = done, total


@pytest.fixture(scope="module")
def whole(jobs, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[JobOutcome, Shown]]:
    """whole(name): a job that was run at once, and what its bar showed."""

    @cache
    def whole(name: str) -> tuple[JobOutcome, Shown]:
        bar = Shown()
        return run(jobs(name, tmp_path_factory.mktemp(name) / "out"), JobProgress(bar, "rows")), bar

    return whole


@pytest.mark.parametrize("name", NAMES)
def test_tasks_resume_and_stop(jobs, whole, tmp_path: Path, name: str):
    outcome, bar = whole(name)
    assert outcome.rows > 0
    assert bar.last == (sum(part.rows for part in outcome.parts) or outcome.rows,) * 2
    stopped = run(jobs(name, tmp_path), Stop())
    assert stopped.cancelled
    assert not stopped.paths
    assert not any(run(jobs(name, tmp_path), array=(task, 2)).cancelled for task in (1, 0))
    assert contents(tmp_path) == contents(outcome.job.folder)
    again = run(jobs(name, tmp_path))
    assert (again.made, again.present) == (0, outcome.rows)
    data = job_report(outcome)
    assert json.loads(json.dumps(data)) == data
    assert {"asked", "made", "present", "out", "shards", "device", "seconds", "starved", "cancelled"} <= set(data)


@pytest.mark.parametrize("name", ["simulate", "metrics"])
def test_a_lost_part_is_made_again(jobs, whole, tmp_path: Path, name: str):
    folder = whole(name)[0].job.folder
    lost, *others = sorted(shutil.copytree(folder, tmp_path / "out").rglob("*.h5"))
    kept = [path.stat().st_mtime_ns for path in others]
    lost.unlink()
    assert run(jobs(name, tmp_path / "out")).written == [lost]
    assert contents(tmp_path / "out") == contents(folder)
    assert [path.stat().st_mtime_ns for path in others] == kept


def test_other_rows_are_another_run(jobs, source: Path, tmp_path: Path):
    (one, *_) = sorted(source.glob("*.h5"))
    shard = read_shard(one)
    write_shard(tmp_path / "in" / one.name, shard)
    job = jobs("refine", tmp_path / "out").changed(shards=(tmp_path / "in",))
    run(job)
    other = sorted(source.glob("*.h5"))[1]
    write_shard(tmp_path / "in" / one.name, read_shard(other))
    with pytest.raises(Exception, match="belongs to another run"):
        run(job.changed())
    assert run(job.changed(), resume=False).made == len(read_shard(other).grasps)
