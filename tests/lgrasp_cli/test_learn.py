"""``lgrasp learn``: a predictor is trained, kept, measured; one line for bad input."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from support.fresh import loaded
from support.jaws import Jaws

import lgrasp as lg
from lgrasp.dataset.reader import ShardReader, read_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.cache import Cache
from lgrasp.jobs.requests.shards import GraspRequest
from lgrasp.learn.grasp.params import GraspParams
from lgrasp.learn.grasp.solids import random_solids, solid_arrays
from lgrasp.learn.network import CoarseNet
from lgrasp.learn.networks import network_bytes
from lgrasp.learn.params import LearnParams
from lgrasp_cli.progress import JobProgress


def test_fit_and_eval(generate, cli):
    assert generate().code == 0
    options = ["--steps", 10, "--joint-steps", 2, "--unrolled", 1, "--batch", 8, "--device", "cpu"]
    done = cli("learn", "fit", "out", "--out", "net.pt", *options, "--json", "fit.json")
    assert done.code == 0, done
    assert "jointly through the refiner" in done.out
    data = json.loads(Path("fit.json").read_text())
    assert data["objects"] == ["tiny"]
    assert data["frozen"]["poses"] == data["joint"]["poses"] > 0
    told = cli("learn", "eval", "net.pt", "out", "--clouds", 1, "--device", "cpu", "--json", "-")
    found = json.loads(told.out)
    assert found["rounds"] == [3, 6, 10, 13]
    assert len(found["refined"]) == 4
    assert found["refined"][-1] < found["coarse"]
    assert found["unknown"] == []
    for name in ("alone", "searched"):
        of_all = found[name]
        assert of_all["objects"]["tiny"]["valid"] == of_all["valid"] <= found["poses"]
        assert of_all["force_closure"] <= of_all["valid"]
    assert found["searched"]["valid"] >= found["alone"]["valid"]
    told = cli("learn", "show", "net.pt", "--plot", "curve.png", "--json", "card.json")
    assert told.code == 0, told
    assert "poses, loss" in told.out
    curves = json.loads(Path("card.json").read_text())["report"]["curves"]
    assert curves == data["curves"]
    assert [step for step, _ in curves["poses"]["loss"]] == list(range(1, 11))
    assert len(curves["joint"]["energy"]) == 2
    assert Path("curve.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert "its card has no curve" in cli("learn", "show", "seq-allegro", "--plot", "curve.png").error()
    assert "ends in .png" in cli("learn", "show", "net.pt", "--plot", "curve.svg").error()
    Path("bad.pt").write_bytes(b"nonsense")
    assert "not a network" in cli("learn", "eval", "bad.pt", "out").error()
    assert "absent.pt: no such file, nor a network" in cli("learn", "eval", "absent.pt", "out").error()


def test_solids_of_an_interrupted_training_are_kept(generate, cli, monkeypatch):
    assert generate(rows=64).code == 0
    sizes = ["nodes=8", "channels=2", "completion_batch=4", "held_out=0", "shapes=1", "views=2", "cloud=64"]
    options = [option for size in sizes for option in ("--set", f"grasp.{size}")]
    monkeypatch.setattr(
        JobProgress, "advanced", lambda self, part, n, note="", *_: setattr(self, "stop", "clouds" in note)
    )
    done = cli("learn", "fit", "--model", "grasp", "out", "--out", "net.pt", "--device", "cpu", *options)
    assert (done.code, done.err) == (130, "interrupted: what was prepared is kept; the same command goes on\n")


def test_interrupted_before_there_is_anything_to_report(generate, cli, monkeypatch):
    assert generate(rows=20).code == 0
    monkeypatch.setattr(JobProgress, "cancelled", lambda self: True)
    done = cli("learn", "fit", "out", "--out", "net.pt", "--device", "cpu")
    assert (done.code, done.out) == (130, "")
    assert done.err == "interrupted: nothing is finished; the same command begins again\n"
    assert not Path("net.pt").exists()


def interrupted_at(steps, monkeypatch, *, count=False):
    """Ctrl-C once so many steps are done, or so many calls told of them."""
    done = [0]
    monkeypatch.setattr(JobProgress, "advanced", lambda self, part, n, *_: done.append(len(done) if count else n))
    monkeypatch.setattr(JobProgress, "cancelled", lambda self: done[-1] >= steps)


@pytest.fixture
def kept(monkeypatch):
    """Files of what trainings of this test keep in the cache, which other tests use as well."""
    paths, store = set(), Cache.store

    def noted(self, kind, key, arrays):
        store(self, kind, key, arrays)
        if kind == "training":
            paths.add(self.path(kind, key))

    monkeypatch.setattr(Cache, "store", noted)
    return paths


def weights(path):
    return {name: values.tolist() for name, values in torch.load(path, weights_only=True).items()}


def test_interrupted_trainings_go_on(generate, cli, monkeypatch, kept):
    """In the first phase and in the last: the network is as if they had not been interrupted, and nothing is left."""
    assert generate(rows=20).code == 0
    asked = ["--steps", 10, "--joint-steps", 3, "--unrolled", 1, "--batch", 8, "--device", "cpu"]
    assert cli("learn", "fit", "out", "--out", "whole.pt", *asked).code == 0
    for steps, words in ((1, "1 step is"), (15, "15 steps are")):
        with monkeypatch.context() as patch:
            interrupted_at(steps, patch)
            done = cli("learn", "fit", "out", "--out", "net.pt", *asked)
        assert done.code == 130
        assert done.err == f"interrupted: {words} kept; the same command makes the rest\n"
        assert not Path("net.pt").exists()
    assert [path.exists() for path in kept] == [True]
    done = cli("learn", "fit", "out", "--out", "net.pt", *asked, "--json", "fit.json")
    assert done.code == 0
    told = json.loads(Path("fit.json").read_text())
    assert (told["made"], told["present"]) == (1, 15)  # steps of this run, and of those before
    assert weights("net.pt") == weights("whole.pt")
    shown = [json.loads(cli("learn", "show", path, "--json", "-").out)["report"] for path in ("net.pt", "whole.pt")]
    assert shown[0]["curves"] == shown[1]["curves"]
    assert shown[0]["joint"] == shown[1]["joint"]
    assert [path.exists() for path in kept] == [False]


def test_a_rebuilt_training_that_is_interrupted_says_what_goes_on(generate, cli, monkeypatch):
    """With --rebuild the next run would begin again."""
    assert generate(rows=20).code == 0
    interrupted_at(3, monkeypatch)
    asked = ["--steps", 10, "--joint-steps", 0, "--batch", 8, "--device", "cpu", "--set", "coarse.seed=7"]
    done = cli("learn", "fit", "out", "--out", "net.pt", *asked, "--rebuild")
    assert done.err == "interrupted: 3 steps are kept; the same command without --rebuild makes the rest\n"


def test_bad_options(cli):
    line = cli("learn", "fit", "--model", "pose", "--steps", 5).error()
    assert "--steps is for --model coarse, diffuser, grasp; --set pose.KEY=VALUE takes shapes, " in line
    assert "epochs" in line
    assert "--unrolled is for --model coarse;" in cli("learn", "fit", "x", "--model", "grasp", "--unrolled", 5).error()
    assert "no such file or folder" in cli("learn", "fit", "absent").error()
    for option, value in (("batch", 0), ("steps", -1), ("unrolled", 101), ("seed", -1)):
        assert f"key '{option}' = {value}" in cli("learn", "fit", "absent", f"--{option}", value).error()


def test_shards_that_cannot_be_learned_from(generate, cli, tmp_path):
    def refused(*shards):
        line = cli("learn", "fit", *shards, "--out", "net.pt", "--device", "cpu").error()
        assert not Path("net.pt").exists()
        return line

    assert generate(rows=3).code == 0
    (path,) = Path("out").glob("*.h5")
    with ShardReader(path) as reader:
        none = replace(read_shard(path), grasps=reader.rows(0, 0))
    write_shard("starved.h5", none)
    shutil.copytree("out", "whole")
    assert ": 3 grasps; at least 16 are needed" in refused("starved.h5", "out")
    with h5py.File(path, "r+") as file:
        file["grasps/q"][1, 2] = np.nan
    assert f"{path}: q is not finite (row 1, 1 rows)" in refused("out")
    write_shard("other/jaws-cube-00000.h5", Jaws(tmp_path).shard())
    line = refused("whole", "other")
    assert "jaws-cube-00000.h5: its grasps are of hand 'jaws'" in line
    assert f"those of whole/{path.name} of 'allegro'" in line
    assert (
        "out cannot be written: it is a folder" in cli("learn", "fit", "out", "--out", "out", "--device", "cpu").error()
    )


def test_files_that_are_no_predictors(cli):
    params = LearnParams.model_validate({"width": 8})
    net = CoarseNet(torch.zeros(2), torch.ones(2), params)
    Path("none.h5").touch()  # the predictor is read first
    card = {"kind": "coarse", "version": 2, "hand": "h", "hand_sha256": "0" * 64, "report": {}}
    card |= {"params": params.model_dump(mode="json")}
    good = net.state_dict()
    for change, state, words in (
        ({"version": 9}, good, "version 9"),
        ({"kind": "other"}, good, "kind 'other'"),
        ({"hand": 3}, good, "hand is 3"),
        ({"params": {}}, good, "size mismatch"),
        ({"params": "?"}, good, "net.pt"),
        ({}, {}, "'lower'"),
        ({}, {name: values * float("nan") for name, values in good.items()}, "not finite"),
    ):
        Path("net.pt").write_bytes(network_bytes(card | change, state))
        line = cli("learn", "eval", "net.pt", "none.h5").error()
        assert "net.pt: not a network of lgrasp learn fit" in line
        assert words in line
    torch.save(good, "net.pt")
    assert "no item named" in cli("learn", "eval", "net.pt", "none.h5").error()
    Path("net.pt").write_bytes(network_bytes(card, good))
    data = Path("net.pt").read_bytes()
    assert "absent: no such file" in cli("learn", "eval", "net.pt", "absent").error()
    Path("net.pt").write_bytes(data[: len(data) // 2])
    assert "not a network" in cli("learn", "eval", "net.pt", "none.h5").error()


def test_networks_are_known_by_name(generate, cli, monkeypatch, tmp_path):
    """A file in a data folder is listed with its card, and read by its name."""
    (tmp_path / "models").mkdir()
    monkeypatch.setenv("LGRASP_PATH", str(tmp_path))
    net = CoarseNet(torch.zeros(2), torch.ones(2), params := LearnParams.model_validate({"width": 8}))
    card = {"kind": "coarse", "version": 2, "hand": "allegro", "hand_sha256": "0" * 64}
    report = {"objects": ["a", "b"], "unseen": ["c"], "examples": 1200, "loss": 0.25, "params": {"seed": 3}}
    data = network_bytes(card | {"params": params.model_dump(mode="json"), "report": report}, net.state_dict())
    (tmp_path / "models" / "toy.pt").write_bytes(data)
    (tmp_path / "models" / "bad.pt").write_bytes(b"nonsense")
    found = {n["name"]: n for n in json.loads(cli("learn", "list", "--json", "-").out)}
    assert found["toy"]["report"] == report
    assert found["toy"]["bytes"] == len(data)
    assert found["bad"]["kind"].startswith("cannot be used: ")
    assert found["hand"]["kind"].startswith("pose")  # shipped with hands
    lines = cli("learn", "list").out.splitlines()
    assert any("130 objects" in line for line in lines if line.startswith("hand"))  # by their names in the card
    (line,) = (line for line in lines if line.startswith("toy"))
    assert line.split("  ")[-1].strip() == "loss 0.25"
    assert "2 objects, 1 object held out, 1,200 examples, seed 3" in line
    assert generate(rows=3).code == 0
    assert "toy.pt is of hand 'allegro', the shards" in cli("learn", "eval", "toy", "out", "--device", "cpu").error()
    assert "did you mean 'toy'" in cli("learn", "eval", "toi", "out").error()
    assert loaded("from lgrasp.jobs.listing import list_networks; list_networks()", ["torch"]) == []


def test_two_runs_that_make_solids_at_once(generate, tmp_path, monkeypatch):
    """What one made while the other was at it is skipped there: each solid has its number's place."""
    assert generate(rows=4).code == 0
    monkeypatch.setattr("lgrasp.jobs.learn.grasp._SOLIDS", 2)
    asked = GraspRequest(shards=(Path("out"),), params=GraspParams(shapes=6, cloud=64), device="cpu")
    one, other = (asked.job(Cache(tmp_path / "cache")) for _ in range(2))
    solids = list(random_solids(0, range(6), 64))

    def told(done, note):
        if note == "2 of 6 solids":
            other.kept("solids 2", lambda: solid_arrays(solids[2:4]))

    for job in (one, other):
        for found, right in zip(job._solids(told), solids, strict=True):
            assert np.array_equal(found.grid.values, right.grid.values)


def test_grasps_are_planned_from_a_cloud_by_a_network(generate, cli):
    assert generate(rows=64).code == 0
    sizes = ["width=32", "blocks=1", "cloud=64", "shape_points=32", "held_points=32", "sense_points=1", "views=4"]
    sizes += ["turns=2", "nodes=8", "channels=2", "completion_steps=2", "completion_batch=4", "held_out=0", "shapes=2"]
    options = [option for size in sizes for option in ("--set", f"grasp.{size}")]
    fit = ["learn", "fit", "--model", "grasp", "out", "--steps", 2, "--batch", 64, "--device", "cpu", *options]
    done = cli(*fit, "--out", "net.pt", "--json", "fit.json")
    assert done.code == 0, done
    report = json.loads(Path("fit.json").read_text())
    assert report["examples"] == 64
    assert {part: list(curves) for part, curves in report["curves"].items()} == {
        "completion": ["loss"],
        "drawing": ["loss"],  # no object is held out
    }
    assert cli(*fit, "--out", "again.pt").code == 0
    one, two = (torch.load(name, weights_only=True) for name in ("net.pt", "again.pt"))
    assert all(torch.equal(values, two[name]) for name, values in one.items())
    told = cli(
        "learn", "eval", "net.pt", "out", "--clouds", 1, "-n", 2, "--out", "plans", "--device", "cpu", "--json", "-"
    )
    assert told.code == 0, told
    found = json.loads(told.out)["kinds"]["one view"]["tiny"]
    assert found["asked"] == 2
    assert found["delivered"] == sum(len(lg.open(path)) for path in Path("plans/one-view").glob("*.h5"))
    points = lg.load_object("tiny")
    seen = points.contact_normals[:, 2] > 0
    cloud = np.column_stack([points.contact_points, points.contact_normals])[seen]
    np.save("cloud.npy", cloud)
    plan = ["plan", "--cloud", "cloud.npy", "-n", 3, "--device", "cpu", "--out", "planned", "--keep-invalid"]
    assert cli(*plan, "--model", "net.pt").code == 0
    (path,) = Path("planned").glob("*.h5")
    grasps = lg.open(path)
    assert len(grasps) == 3
    assert grasps.header.config["network"]
    assert "of hand 'allegro', not of 'barrett'" in cli(*plan, "--model", "net.pt", "--hand", "barrett").error()
    assert "absent: no such file, nor a network" in cli(*plan, "--model", "absent").error()
    assert "(kind 'diffuser')" in cli(*plan, "--model", "seq-allegro").error()


def test_a_pose_policy_is_trained_and_used(cli, tmp_path, monkeypatch, kept):
    pipeline = tmp_path / "small.yaml"
    stages = "[place: {samples: 12}, domain: {rounds: 2}, ik: {}, search: {}, filter: {}]"
    pipeline.write_text(f"name: small\nfield: {{records: 20000}}\nstages: {stages}\n")
    options = ["--model", "pose", "--pipeline", pipeline, "--device", "cpu", "--object", "sphere", "--object", "tiny"]
    options += ["--set", "pose.candidates=64", "--set", "pose.epochs=1"]
    assert cli("learn", "fit", *options, "--out", "a.npz").code == 0
    for calls in (3, 1, 5):  # amid examples; at once, with what is kept; in the training
        with monkeypatch.context() as patch:
            interrupted_at(calls, patch, count=True)
            done = cli("learn", "fit", *options, "--out", "b.npz")
        assert done.code == 130, done
        assert " objects are kept; the same command makes the rest" in done.err
    done = cli("learn", "fit", *options, "--out", "b.npz", "--json", "fit.json")
    assert done.code == 0, done
    assert len(kept) > 3
    assert not any(path.exists() for path in kept)
    assert Path("a.npz").read_bytes() == Path("b.npz").read_bytes()
    assert "--set place.policy=b.npz" in done.out
    report = json.loads(Path("fit.json").read_text())
    assert report["yielding"] > 16
    assert abs(sum(report["sources"].values()) - 1) < 1e-9
    assert report["sources"]["pinch"] > report["sources"]["palm"] > 0  # a palm alone rarely has two fingers about it
    assert "contacts, loss" in cli("learn", "show", "b.npz").out
    use = ["generate", "--object", "tiny", "-n", 5, "--pipeline", pipeline, "--out", "rated", "--device", "cpu"]
    assert cli(*use, "--set", "place.policy=a.npz").code == 0
    assert "place.policy: absent.npz: No such file" in cli(*use, "--set", "place.policy=absent.npz").error()
    assert "a pose policy takes no shards" in cli("learn", "fit", "rated", "--model", "pose").error()
    assert "--hand is for --model pose only" in cli("learn", "fit", "rated", "--hand", "allegro").error()
    assert "name shards to learn from" in cli("learn", "fit").error()
