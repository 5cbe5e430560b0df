"""Metrics added to shards, and the stored ones, against exact solutions."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull
from support.wrench import cone_forces, epsilon, residual, wrenches
from typer.testing import CliRunner

from lgrasp.config import parse_model
from lgrasp.dataset.metrics import mass_frame, measured_in, row_metrics
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.report.write import read_dataset
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.events import Events, JobOutcome
from lgrasp.engine.report import job_report
from lgrasp.engine.run import run
from lgrasp.engine.run import run as generate
from lgrasp.errors import ConfigError, OutputError, ShardError
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.metrics import MetricsJob
from lgrasp_cli.dataset import app

BOTH = ("volume", "epsilon_exact")


def add_metrics(paths, out, names, events=None, **options) -> JobOutcome:
    given = tuple(paths) if isinstance(paths, list) else (paths,)
    return run(MetricsJob(shards=given, out=out, add=names, device="cpu", **options), events)


class Watch(Events):
    """Rows done of all parts."""

    def __init__(self):
        self.done, self.seen = {}, []

    def advanced(self, part, done, *more):
        self.done[part.number] = done
        self.seen.append(sum(self.done.values()))


def grip(shard, o=0):
    """For each row of a shard: contact points, inward normals, and the object as a mesh."""
    for r in range(len(shard.grasps)):
        touch = shard.grasps.contact_links[r, o] >= 0
        record = shard.objects[shard.grasps.object_index[r, o]]
        points, normals = shard.grasps.contact_points[r, o, touch], -shard.grasps.contact_normals[r, o, touch]
        mesh = trimesh.Trimesh(record.vertices, record.faces, process=False)
        normals = normals / np.linalg.norm(normals.astype(float), axis=1, keepdims=True)
        yield points.astype(float), normals, mesh


@pytest.fixture(scope="module")
def measured(small_job, tmp_path_factory):
    """Grasps of the pipeline with both metrics."""
    folder = tmp_path_factory.mktemp("measured")
    given = small_job | {"rows": 20, "shard_rows": 20, "out": folder / "out"}
    generate(parse_model(GenerateJob, given, "generate"))
    add_metrics(folder / "out", folder / "more", BOTH, workers=1)
    (path,) = (folder / "more").glob("*.h5")
    assert validate_shard(path) == []
    return read_shard(path)


def test_generated_grasps(measured):
    """Epsilon of the shard is a bound from above, a close one; the added numbers are those of the exact hull."""
    metrics, closed = measured.grasps.metrics, 0
    for r, (points, normals, mesh) in enumerate(grip(measured)):
        arms, radius = points - mesh.center_mass, np.linalg.norm(mesh.vertices - mesh.center_mass, axis=1).max()
        exact = epsilon(arms, normals, 0.5, radius)
        assert metrics["epsilon_exact"][r] == pytest.approx(exact, abs=1e-6)
        assert metrics["epsilon"][r] >= exact - 2e-5 or exact < 2.5e-4
        closed += exact > 1e-3
        hull = ConvexHull(wrenches(arms, cone_forces(normals, 0.5, 8), 1 / radius))
        volume = sum(abs(np.linalg.det(hull.points[s] - hull.points.mean(0))) for s in hull.simplices) / 720
        assert metrics["volume"][r] == pytest.approx(volume if exact > 1e-7 else 0, rel=1e-4, abs=1e-9)
    assert closed > 5
    tight = metrics["epsilon"] - metrics["epsilon_exact"]
    assert np.median(tight[metrics["epsilon_exact"] > 1e-3] / metrics["epsilon_exact"].max()) < 0.01


def test_stored_residuals(measured):
    """fswo and gswo are least norms, by non-negative least squares; gswo stops below 1e-4."""
    metrics = measured.grasps.metrics
    for r, (points, normals, _) in enumerate(grip(measured)):
        arms = points - points.mean(0)
        assert metrics["fswo"][r] == pytest.approx(residual(arms, normals, 0.0, 1, 10.0), abs=2e-4)
        gswo = residual(arms, normals, 0.5, 8, 10.0)
        assert gswo - 1e-4 <= metrics["gswo"][r] <= max(gswo, 1e-4) + 1e-4


def test_what_the_rows_show_together(run, tmp_path):
    """The report has coverage and diversity of all shards of an object, as the report of the data set."""
    run(rows=10, shard_rows=5)
    outcome = add_metrics(tmp_path / "out", tmp_path / "more", ["volume"], workers=1)
    (found,) = job_report(outcome)["sets"]
    (hand,) = read_dataset(tmp_path / "more")[0]["hands"]
    (group,) = hand["objects"]
    assert (found["hand"], found["objects"], found["rows"]) == ("allegro", ["mug"], 10)
    assert found["diversity"] == group["diversity"]
    assert found["coverage"]["mug"]["surface"] == group["coverage"]["mug"]["surface"]
    assert 0 < found["coverage"]["mug"]["surface"]["share"] < 1
    assert hand["diversity"] == group["diversity"]["mug"]


def test_all_else_stays(tmp_path, make_shard, same_rows):
    shard = make_shard(20, contacts=5)
    write_shard(tmp_path / "in" / "a.h5", shard)
    with h5py.File(tmp_path / "in" / "a.h5", "r+") as file:
        file["mine/numbers"] = np.arange(3)
        del file.attrs["text_sha256"]
    added = add_metrics(tmp_path / "in", tmp_path / "out", ["volume"], workers=1)
    assert (added.paths, added.written, added.made) == ([tmp_path / "out" / "a.h5"],) * 2 + (20,)
    assert validate_shard(tmp_path / "out" / "a.h5") == []
    new = read_shard(tmp_path / "out" / "a.h5")
    assert new.grasps.metric_units["volume"] == ""
    metrics = {name: values for name, values in new.grasps.metrics.items() if name != "volume"}
    units = {name: unit for name, unit in new.grasps.metric_units.items() if name != "volume"}
    same_rows(shard.grasps, replace(new.grasps, metrics=metrics, metric_units=units))
    assert new.header == shard.header
    assert new.statistics == {**shard.statistics, "volume_measured": '{"friction": 0.5}'}
    with h5py.File(tmp_path / "out" / "a.h5") as file:
        assert file["mine/numbers"][:].tolist() == [0, 1, 2]
    # a metric that is there is replaced
    again = tmp_path / "again" / "a.h5"
    with h5py.File(tmp_path / "out" / "a.h5", "r+") as file:
        file["grasps/metrics/volume"][:] = 7.0
    add_metrics(tmp_path / "out", again.parent, ["volume"], workers=1)
    np.testing.assert_array_equal(read_shard(again).grasps.metrics["volume"], new.grasps.metrics["volume"])


def test_processes_change_nothing(tmp_path, make_shard):
    for i in range(3):
        write_shard(tmp_path / "in" / f"{i}.h5", make_shard([6, 0, 3][i], contacts=5, shard_index=i))
    watch = Watch()
    add_metrics(tmp_path / "in", tmp_path / "one", BOTH, watch, workers=1)
    add_metrics(tmp_path / "in", tmp_path / "two", BOTH, workers=2)
    assert watch.seen[-1] == 9
    assert watch.seen == sorted(watch.seen)
    for i in range(3):
        assert (tmp_path / "one" / f"{i}.h5").read_bytes() == (tmp_path / "two" / f"{i}.h5").read_bytes()


def test_several_objects_give_the_least(make_shard):
    """A row is as good as its worst object; absent objects and other shards' padding do not count."""
    shard = make_shard(20, objects=3, columns=2, contacts=6)
    frames = [mass_frame(record) for record in shard.objects]
    got = row_metrics(shard.grasps, frames, 0.5)
    alone = []
    for o in range(2):
        one = {n: v[:, o : o + 1] for n, v in shard.grasps.columns().items() if n.startswith(("object_", "contact_"))}
        values = row_metrics(replace(shard.grasps, **one), frames, 0.5)
        alone.append(np.where(shard.grasps.object_index[:, o, None] >= 0, values, np.inf))
    np.testing.assert_array_equal(got, np.minimum(*alone))
    assert np.isfinite(got).all()
    assert (got > 0).any()
    assert (shard.grasps.object_index[:, 1] < 0).any()


def test_mass_frame(make_shard):
    record = make_shard(1).objects[0]  # a tetrahedron
    center, radius = mass_frame(record)
    np.testing.assert_allclose(center, 0.05 / 4 * np.ones(3), atol=1e-9)
    assert radius == pytest.approx(0.05 * np.sqrt(0.75**2 + 2 * 0.25**2))
    opened, _ = mass_frame(replace(record, faces=record.faces[:3], watertight=False))
    np.testing.assert_allclose(opened, center, atol=1e-9)


def test_resume(tmp_path, make_shard):
    for i in range(3):
        write_shard(tmp_path / "in" / "sub" / f"{i}.h5", make_shard(2, shard_index=i))
    out = tmp_path / "in" / "out"  # inside the folder, and yet no input of its own
    assert add_metrics(tmp_path / "in", out, ["volume"], workers=1).made == 6
    times = {path: path.stat().st_mtime_ns for path in out.rglob("*.h5")}
    assert [path.relative_to(out).as_posix() for path in sorted(times)] == ["sub/0.h5", "sub/1.h5", "sub/2.h5"]
    whole = (out / "sub" / "1.h5").read_bytes()
    (out / "sub" / "1.h5").write_bytes(whole[:-50])
    (out / "sub" / "2.h5").unlink()
    assert add_metrics(tmp_path / "in", out, ["volume"], workers=1).made == 4
    assert (out / "sub" / "1.h5").read_bytes() == whole
    assert (out / "sub" / "0.h5").stat().st_mtime_ns == times[out / "sub" / "0.h5"]
    assert add_metrics(tmp_path / "in", out, BOTH, workers=1).made == 6  # one more metric
    write_shard(tmp_path / "in" / "sub" / "0.h5", make_shard(2, seed=9))
    with pytest.raises(OutputError, match=r"0\.h5 holds other rows than .*choose another --out"):
        add_metrics(tmp_path / "in", out, BOTH, workers=1)


def test_attributes_of_other_writers_may_be_arrays(tmp_path, make_shard):
    for name in ("a.h5", "b.h5"):
        write_shard(tmp_path / name, make_shard(2))
        with h5py.File(tmp_path / name, "r+") as file:
            file.attrs["bias"] = [1.0, 2.0]
            del file.attrs["text_sha256"]
    assert measured_in(tmp_path / "a.h5", tmp_path / "b.h5") == {}


def test_a_copy_keeps_what_was_measured(tmp_path, make_shard):
    """More metrics are added to it; one is not measured again with other numbers unless asked to."""
    write_shard(tmp_path / "in" / "0.h5", make_shard(4, contacts=5))
    out, path = tmp_path / "out", tmp_path / "out" / "0.h5"
    add_metrics(tmp_path / "in", out, ["volume"], workers=1)
    first = read_shard(path).grasps.metrics["volume"]
    assert add_metrics(tmp_path / "in", out, ["epsilon_exact"], workers=1).made == 4
    assert set(BOTH) <= set(read_shard(path).grasps.metrics)
    np.testing.assert_array_equal(read_shard(path).grasps.metrics["volume"], first)
    slippery = {"settings": ("bounds.friction=0.9",), "workers": 1}
    words = r"0\.h5 has (volume|epsilon_exact) measured .* \(friction: 0\.5 there, 0\.9 requested\); choose another"
    whole = path.read_bytes()
    for names in (["volume"], BOTH):
        with pytest.raises(OutputError, match=words):
            add_metrics(tmp_path / "in", out, names, **slippery)
    assert path.read_bytes() == whole
    run(MetricsJob(shards=(tmp_path / "in",), out=out, add=("volume",), device="cpu", **slippery), resume=False)
    assert read_shard(path).statistics["volume_measured"] == '{"friction": 0.9}'
    assert add_metrics(tmp_path / "in", out, ["volume"], **slippery).made == 0
    with h5py.File(path, "r+") as file:
        file["statistics"].attrs["volume_measured"] = "[9"
        del file.attrs["text_sha256"]
    with pytest.raises(OutputError, match=r"measured with other numbers \(unknown there\)"):
        add_metrics(tmp_path / "in", out, ["volume"], **slippery)


def test_what_cannot_be_done(tmp_path, make_shard):
    write_shard(tmp_path / "a" / "0.h5", make_shard(4))
    write_shard(tmp_path / "b" / "0.h5", make_shard(4, seed=1))
    out = tmp_path / "out"
    with pytest.raises(ValueError, match="should be 'volume', 'epsilon_exact' or 'hold'"):
        add_metrics(tmp_path / "a", out, ["volum"])
    with pytest.raises(OutputError, match="is the folder of the shards"):
        add_metrics(tmp_path / "a" / "0.h5", tmp_path / "a", ["volume"])
    with pytest.raises(ShardError, match=r"it has the same place 0\.h5 as"):
        add_metrics([tmp_path / "a", tmp_path / "b"], out, ["volume"])
    with pytest.raises(ShardError, match="no such file"):
        add_metrics(tmp_path / "c", out, ["volume"])
    wide = make_shard(4)
    told = {"bounds": {"profile": "strict", "numbers": {"max_gap": 0.5}}}
    write_shard(tmp_path / "w" / "0.h5", replace(wide, header=replace(wide.header, config=told)))
    with pytest.raises(ConfigError, match=r"w/0\.h5: bounds: .*max_gap"):
        add_metrics(tmp_path / "w", out, ["volume"])
    with h5py.File(tmp_path / "a" / "0.h5", "r+") as file:
        file["grasps/q"][1, 1] = np.nan
    with pytest.raises(ShardError, match=r"0\.h5: grasps/q: not finite"):
        add_metrics(tmp_path / "a", out, ["volume"], workers=1)
    assert not out.exists()


def test_command(tmp_path, make_shard):
    write_shard(tmp_path / "in" / "0.h5", make_shard(4))
    arguments = ["metrics", str(tmp_path / "in"), "--add", "volume, epsilon_exact", "-o", str(tmp_path / "out")]
    assert "(1 shard)" in CliRunner().invoke(app, [*arguments, "--workers", "1"]).stdout
    assert "rows     0; 4 were there already" in CliRunner().invoke(app, arguments).stdout
    assert CliRunner().invoke(app, [*arguments, "--quiet"]).stdout == ""
    assert set(read_shard(tmp_path / "out" / "0.h5").grasps.metrics) >= set(BOTH)
