"""The verbs of ``import lgrasp as lg`` one after another, in memory and in files."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from support.kernels import kernel_folder
from support.places import QUICK

import lgrasp as lg
from lgrasp.api import _made


@pytest.fixture(scope="module", autouse=True)
def _cache(cache_root):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LGRASP_CACHE_DIR", str(cache_root))
        yield


@pytest.fixture(scope="module")
def grasps(_cache):
    return lg.generate("allegro", "sphere", 12, pipeline=QUICK, device="cpu", seed=3)


def test_rows_in_memory_are_those_on_disk(grasps, tmp_path):
    assert (len(grasps), len(grasps.q), grasps.header.seed) == (12, 12, 3)
    pipeline = lg.load_pipeline(QUICK).model_copy(update={"seed": 3})
    written = lg.generate("allegro", "sphere", 12, pipeline=pipeline, device="cpu", out=tmp_path / "ball")
    for name, values in grasps.columns().items():
        np.testing.assert_array_equal(values, written.columns()[name], err_msg=name)
    (file,) = (tmp_path / "ball").glob("*.h5")
    assert lg.validate_shard(file) == []
    assert len(lg.open(file)) == len(lg.open(tmp_path / "ball")) == 12


def test_steered_rows():
    steered = lg.generate("allegro", "sphere", 5, pipeline=QUICK, steer={"palm": "no"}, device="cpu")
    assert not (steered.contact_links == steered.hand.link_names.index("base_link")).any()
    with pytest.raises(lg.LgraspError, match="fingers: index, middle, ring, thumb"):
        lg.generate("allegro", "mug", 5, steer={"fingers": "pinky"}, device="cpu")


def test_some_of_the_rows(grasps, tmp_path):
    some = grasps[grasps.metrics["gap"] < np.median(grasps.metrics["gap"])]
    assert len(some) == 6
    assert (some.metrics["gap"] < np.median(grasps.metrics["gap"])).all()
    assert repr(some) == "<6 grasps of sphere by allegro, pipeline quick>"
    np.testing.assert_array_equal(grasps[[3, 1]].metrics["gap"], grasps.metrics["gap"][[3, 1]])
    assert len(grasps[2:5]) == 3
    assert len(grasps[[]]) == len(grasps[np.zeros(12, bool)]) == 0
    read = lg.read_shard(some.save(tmp_path / "some.h5"))
    assert len(read.grasps) == 6
    np.testing.assert_array_equal(read.grasps.contact_links, some.contact_links)


def test_table(grasps, monkeypatch):
    table = grasps.to_pandas()
    joints = [name for name in table.columns if name.startswith("q/")]
    assert joints == [f"q/{name}" for name in grasps.hand.joint_names]
    np.testing.assert_array_equal(table[joints].to_numpy(np.float32), grasps.q)
    np.testing.assert_array_equal(table["object_pose/qz"], grasps.object_pose[:, 0, 6])
    np.testing.assert_array_equal(table["metrics/epsilon"], grasps.metrics["epsilon"])
    assert set(table["objects"]) == {"sphere"}
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(lg.LgraspError, match="pip install pandas"):
        grasps.to_pandas()


def test_picture(grasps):
    assert grasps.show([0, 5, 7], size=40).width == 80
    assert grasps.show(1, size=40)._repr_png_().startswith(b"\x89PNG")  # what notebooks ask for
    mask = np.zeros(12, bool)
    mask[[5, 7]] = True
    pictures = [np.asarray(grasps.show(rows, size=40)) for rows in (mask, [5, 7], [0, 1])]
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert (pictures[0] != pictures[2]).any()
    assert grasps.show(np.int64(2), size=40).width == 80
    for wrong, message in (
        ({"rows": [12]}, "row 12 does not exist"),
        ({"rows": []}, r"rows is \[\]; how many"),
        ({"rows": [0.5]}, r"rows is \[0\.5\]"),
        ({"rows": mask[:5]}, "or a mask"),
        ({"stage": "foo"}, "stage is 'foo'; accepted: pregrasp, grasp, squeeze"),
        ({"size": -3}, "size is -3; 32"),
    ):
        with pytest.raises(lg.LgraspError, match=message):
            grasps.show(**wrong)


def test_refine_simulate_judge(grasps):
    some = grasps[:3]
    refined = lg.refine(some, matching_rounds=1)
    assert refined.hand.sha256 == some.hand.sha256
    assert 0 < len(refined) <= 3
    assert lg.judge(some).passed
    pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")
    held = lg.simulate(some, "fc")
    np.testing.assert_array_equal(held.q, some.q)
    assert held.physics["fc_holds"].shape == (3,)


FORKED = """
import multiprocessing, sys, warnings
import lgrasp as lg
rows = lg.open(sys.argv[1])
warnings.simplefilter("ignore")
how = {"matching_rounds": 1, "device": "cpu"}
one = lg.refine(rows, **how)
with multiprocessing.get_context("fork").Pool(1) as pool:
    other = pool.apply_async(lg.refine, [rows], how).get(60)
assert (one.q == other.q).all()
"""


def test_a_forked_process_refines_as_well(grasps, tmp_path):
    """What torch and Warp started before the fork is not there."""
    file = grasps[:3].save(tmp_path / "some.h5")
    env = os.environ | {"WARP_CACHE_PATH": str(kernel_folder())}
    subprocess.run([sys.executable, "-c", FORKED, file], env=env, check=True, timeout=100)


def test_plan():
    assert 0 < len(lg.plan("barrett", "mug", starts=3, device="cpu")) <= 3


def test_what_cannot_be_used_is_an_error_of_this_package(grasps, tmp_path):
    none = grasps[np.zeros(len(grasps), bool)]
    for use in (lg.refine, lg.simulate, lg.Grasps.show):
        with pytest.raises(lg.LgraspError, match=r"^0 grasps are given; at least one is needed$"):
            use(none)
    empty = none.save(tmp_path / "empty.h5")
    with pytest.raises(lg.LgraspError, match=r"empty\.h5: no grasp in it"):
        lg.open(empty)
    spoilt = grasps[:3]
    spoilt.q[1, 2] = np.nan
    for use in (lg.refine, lg.simulate, lg.judge):
        with pytest.raises(lg.LgraspError, match=r"^grasps/q: not finite \(row 1, 1 rows\)$"):
            use(spoilt)
    for rows in (0, -3):
        with pytest.raises(lg.LgraspError, match=f"rows is {rows}; how many"):
            grasps.show(rows)
    np.save(tmp_path / "few.npy", np.zeros((3, 3)))
    with pytest.raises(lg.LgraspError, match=r"few\.npy: .*at least 50"):
        lg.plan("allegro", tmp_path / "few.npy", device="cpu")
    with pytest.raises(lg.LgraspError, match="at least two objects, got spere"):
        lg.sequence("allegro", "spere", device="cpu")
    for n in ("5", None, True):
        with pytest.raises(lg.LgraspError, match=r"n is .*; a whole number is accepted"):
            lg.generate("allegro", "sphere", n)
    with pytest.raises(lg.LgraspError, match=r"steer is a str; accepted is such as \{'fingers'"):
        lg.generate("allegro", "sphere", 5, steer="tripod")
    with pytest.raises(lg.LgraspError, match="pipeline is a int"):
        lg.load_pipeline(5)
    with pytest.raises(lg.LgraspError, match="out is a int; the path of a folder"):
        lg.generate("allegro", "sphere", 5, out=5)
    with pytest.raises(lg.LgraspError, match=r"hand is a str; what lg\.load_hand gives is accepted"):
        lg.Refiner("barrett", "mug")


def test_hands_of_shards_are_written_once(grasps, tmp_path):
    path = grasps[:2].save(tmp_path / "few.h5")
    lg.load_hand(path)
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(3):
        assert lg.load_hand(path).name == grasps.hand.name
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_few_contacts():
    """One finger and the palm, where a pose has both: no row beyond the poses is read."""
    swift = lg.load_pipeline("swift").with_settings(["search.contacts=[1, 3]"])
    rows = lg.generate("allegro", "mug", 30, pipeline=swift, device="cpu")
    assert len(rows) == 30
    assert rows.metrics["contacts"].min() >= swift.bounds.min_contacts


def test_names_and_no_models():
    """Names are told from what is loaded by them, in one line; numbers and devices of other libraries are taken."""
    hand, ball = lg.load_hand("allegro"), lg.load_object("sphere")
    for use in (
        lambda: lg.generate(hand, "sphere"),
        lambda: lg.generate("allegro", ball),
        lambda: lg.sequence("allegro", ball),
        lambda: lg.sequence("allegro", ["sphere", ball]),
        lambda: lg.plan("allegro", ball),
        lambda: lg.plan(hand, "sphere"),
        lambda: lg.load_hand(hand),
        lambda: lg.load_object(np.zeros((9, 3))),
    ):
        with pytest.raises(lg.LgraspError, match=r"is a (HandModel|ObjectModel|ndarray); a name or the path of a file"):
            use()
    with pytest.raises(lg.LgraspError, match="grasps is a ObjectModel; grasps, a shard, or a folder"):
        lg.refine(ball)
    with pytest.raises(lg.LgraspError, match=r"seed 1\.5: need a whole number"):
        lg.generate("allegro", "sphere", 1, seed=1.5)
    count = np.int64(1)
    made = lg.generate("allegro", "sphere", count, pipeline=QUICK, device=torch.device("cpu"), seed=np.int64(3))
    assert (len(made), made.header.seed) == (1, 3)


def test_sequence():
    pipeline = lg.load_pipeline("sequence")
    pipeline = pipeline.model_copy(update={"field": pipeline.field.model_copy(update={"records": 20_000})})
    pipeline = pipeline.with_params("sequence", width=24, wave=64, waves=3)
    taken = lg.sequence("allegro", ["sphere", "mug"], 2, pipeline=pipeline, scale="0.06:0.08", device="cpu")
    assert sorted(o.name for o in taken.objects) == ["mug", "sphere"]
    assert (taken.object_index[-1] >= 0).all()
    with pytest.raises(lg.LgraspError, match="sequences"):
        taken[:1]


def test_fewer_than_asked(grasps, tmp_path):
    with pytest.warns(UserWarning, match="12 of 20 grasps found"):
        assert len(_made([grasps.save(tmp_path / "few.h5")], 20)) == 12
    for nothing in ([], [grasps[:0].save(tmp_path / "none.h5")]):
        with pytest.raises(lg.LgraspError, match="no grasp found"):
            _made(nothing)


def test_what_there_is():
    assert "allegro" in lg.hands()
    assert "mug" in lg.objects()
    assert {"robust", "swift"} <= set(lg.pipelines())
    assert isinstance(lg.load_hand("allegro"), lg.Hand)
    assert isinstance(lg.load_object("mug"), lg.Object)


def test_nothing_stays_behind(grasps, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    lg.judge(grasps[:1])
    assert list(Path(tmp_path).iterdir()) == []
