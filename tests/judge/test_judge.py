"""The judge must pass a valid grasp and catch each planted defect."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.jawshard import CUBE, JAW, PLATE, URDF, row, write_shard
from typer.testing import CliRunner

from lgrasp.grasp.bounds import GraspBounds
from lgrasp.judge.bounds import JudgeError
from lgrasp.judge.checks import CHECKS
from lgrasp.judge.collision import JudgedHand, JudgedObject, object_in_object
from lgrasp.judge.run import judge
from lgrasp.judge.shard import _resolver, read_shard
from lgrasp_cli.main import app

OF_SEVERAL = {"object_object", "frozen", "parent"}
"""Checks of rows with several objects."""
OF_REGIONS = {"touch", "avoid"}
"""Checks of rows that obey regions, for which see test_regions.py."""
OF_TABLES = {"table", "resting", "approach"}
"""Checks of rows on a table, for which see tests/jobs/test_table.py; ``steered``: tests/jobs/test_steer.py."""


def _failed(report: Any) -> list[set[str]]:
    return [{name for name, mask in report.failed.items() if mask[i]} for i in range(report.rows)]


def test_valid_row_passes_with_exact_numbers(tmp_path: Path) -> None:
    pressed = row(q=[0.024, 0.025, 0.3])  # the left jaw 1 mm into the cube
    metrics = {
        "gswo": ([0.0, 0.0], "1"),
        "penetration": ([0.0, 1e-3], "m"),
        "self_penetration": ([0.0, 0.0], "m"),
        "gap": ([0.0, 1.5], "mm"),
        "normal_error": ([0.0, 0.1], "rad"),
        "closing_penetration": ([0.0, 0.0], "m"),
        "energy_normals": ([0.0, 0.0], "1"),
    }
    report = judge(write_shard(tmp_path / "s.h5", [row(), pressed], metrics))
    assert _failed(report) == [set(), set()]
    assert report.valid_share == 1.0
    assert report.values["penetration_mm"] == pytest.approx([0.0, 1.0], abs=1e-3)
    assert report.values["object_in_link_mm"] == pytest.approx([0.0, 1.0], abs=1e-3)
    assert report.values["link_in_object_mm"] == pytest.approx([0.0, 1.0], abs=1e-3)
    assert report.values["contact_link_mm"] == pytest.approx([0.0, 1.0], abs=1e-3)
    assert report.values["residual"] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert report.values["force_balance"] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert report.values["force_normal_sum_error"] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert report.values["contacts"].tolist() == [2, 2]
    deviations = {name: d["max"] for name, d in report.metrics.items()}
    assert deviations["gswo"] < 1e-6
    assert deviations["penetration [mm]"] == pytest.approx(0.0, abs=1e-3)
    assert deviations["gap [mm]"] == pytest.approx(0.5, abs=1e-3)
    assert deviations["normal_error [deg]"] == pytest.approx(np.degrees(0.1), abs=1e-3)
    assert len(deviations) == 6  # gswo twice; what merely has such a word in its name is another number


def test_the_open_hand_and_the_couplings_of_the_rules_count(tmp_path: Path) -> None:
    path = write_shard(tmp_path / "s.h5", [row(), row(), row(q=[0.025, 0.026, 0.3]), row(), row()])
    coupling = {"slide_right": {"joint": "slide_left", "multiplier": 1.0, "offset": 0.0}}
    with h5py.File(path, "r+") as f:
        f.attrs["config"] = json.dumps({"hand_rules": json.dumps({"mimic": coupling})})
        opened = f["grasps/q"][()] + np.array([0.005, 0.005, 0, 0], "f4")
        opened[1, 2] = -1.001
        opened[3, :2] -= 0.008  # 3 mm into the object
        opened[4, :2] = 0.002  # and the jaws 6 mm into each other
        f["grasps/q_pregrasp"] = opened
    report = judge(path)
    found = [set(), {"limits", "mimic_limits", "mimic"}, {"mimic"}, {"pregrasp"}, {"pregrasp", "closing"}]
    assert _failed(report) == found
    assert report.values["pregrasp_mm"][:4] == pytest.approx([0.0, 0.0, 0.0, 3.0], abs=1e-3)
    assert report.values["closing_mm"] == pytest.approx([0.0, 0.0, 0.0, 0.0, 6.0], abs=1e-3)


@pytest.mark.parametrize("told", [0.0, np.nan, 0.5])
def test_planes_of_no_form_are_refused(tmp_path: Path, told: float) -> None:
    path = write_shard(tmp_path / "s.h5", [row()])
    with h5py.File(path, "r+") as f:
        f["objects/a_cube/tables"] = np.array([[0, 0, told, 0.0, 1.0]], "f4")
    with pytest.raises(JudgeError, match=r"tables: normals of another length than 1"):
        judge(path)


def test_what_no_check_expects_is_told_in_one_line(tmp_path: Path) -> None:
    path = write_shard(tmp_path / "s.h5", [row()])
    with h5py.File(path, "r+") as f:
        vertices = f["objects/a_cube/vertices"]
        vertices[:, 2] = 0.0
    with pytest.raises(JudgeError, match=r"s\.h5: /objects/a_cube: a flat mesh"):
        judge(path)
    path = write_shard(tmp_path / "t.h5", [row()])
    with h5py.File(path, "r+") as f:
        index = f["grasps/object_index"][()]
        del f["grasps/object_index"]
        f["grasps/object_index"] = index.astype("f4")
    with pytest.raises(JudgeError, match=r"object_index: float32 of shape \(1, 1\), not integers"):
        judge(path)


@pytest.mark.parametrize(("told", "friction"), [(0.4, 0.4), ("0.4", 0.5), (-1.0, 0.5), (None, 0.5)])
def test_epsilon_is_compared_at_the_friction_of_the_shard(tmp_path: Path, told: Any, friction: float) -> None:
    path = write_shard(tmp_path / "s.h5", [row()])
    with h5py.File(path, "r+") as f:
        bounds = GraspBounds().describe()
        f.attrs["config"] = json.dumps({"bounds": bounds | {"numbers": bounds["numbers"] | {"friction": told}}})
    assert read_shard(path).friction == friction


def _tilted() -> dict[str, Any]:
    """The cube held by two edges whose faces are 30 deg from the jaws."""
    turn = Rotation.from_euler("x", -30, degrees=True)
    x, y, z, w = turn.as_quat()
    reach = turn.apply([0, 0.02, 0.02])[1]  # the edge furthest along y
    points = [[0, 0.02, 0.019], [0, -0.02, -0.019]]
    return row(q=[reach + 0.005, reach + 0.005, 0.3], pose=[0, 0, 0.035, w, x, y, z], points=points)


def test_planted_defects_are_caught(tmp_path: Path) -> None:
    nan = [[0, 0.02, np.nan], [0, -0.02, 0]]
    cases: list[tuple[str, dict[str, Any], set[str]]] = [
        ("into the palm by 5 mm", row(pose=[0, 0, 0.005, 1, 0, 0, 0]), {"penetration"}),
        ("joint over its limit", row(q=[0.025, 0.025, -1.001], follow=-0.4905), {"limits", "mimic_limits"}),
        ("mimic joint over its limit", row(q=[0.025, 0.025, 0.95], follow=0.485), {"mimic_limits"}),
        ("mimic relation broken", row(follow=0.17), {"mimic"}),
        (
            "contact inside the jaw",
            row(points=[[0, 0.0225, 0], [0, -0.02, 0]]),
            {"contact_on_object", "contact_on_link"},
        ),
        ("contact beside the jaw", row(points=[[0, 0.02, 0], [0.013, -0.02, 0]]), {"contact_on_link", "forces"}),
        ("flipped normal", row(normals=[[0, -1, 0], [0, -1, 0]]), {"stored_normal", "forces"}),
        ("edge contacts", _tilted(), {"normal", "residual", "forces"}),
        ("no forces", row(forces=np.zeros((2, 3))), {"forces"}),
        ("forces too large", row(forces=[[0, -5, 0], [0, 5, 0]]), {"forces"}),
        ("forces that pull", row(forces=[[0, 0.5, 0], [0, -0.5, 0]]), {"forces"}),
        ("forces that slip", row(forces=[[0.3, -0.5, 0], [-0.3, 0.5, 0]]), {"forces"}),
        ("forces in no balance", row(forces=[[0.1, -0.5, 0], [0.1, 0.5, 0]]), {"forces"}),
        ("beyond all numbers", row(pose=[0, 0, 1e30, 1, 0, 0, 0]), {"finite"}),
        ("wrong link", row(links=[2, 2]), {"contact_on_link", "normal"}),
        (
            "one-sided",
            row(points=[[0.005, 0.02, 0], [-0.005, 0.02, 0]], normals=[[0, 1, 0]] * 2, links=[1, 1]),
            {"residual", "forces"},
        ),
        ("no contacts", row(points=np.zeros((0, 3)), normals=np.zeros((0, 3)), links=[]), {"residual"}),
        ("not finite", row(points=nan), {"finite"}),
        ("quaternion not unit", row(pose=[0, 0, 0.035, 0.9, 0, 0, 0]), {"finite"}),
        ("unknown object", row(object=2), {"indices"}),
        ("unknown link", row(links=[1, 6]), {"indices"}),
    ]
    clash = row(q=[0.002, 0.002, 0.3], pose=[0, 0, 0.3, 1, 0, 0, 0])
    # a 3 mm plate across the left jaw: no point of the jaw is more than 1.5 mm inside the plate
    plate = row(q=[0.01, 0.05, 0.3], pose=[0, 0, 0.03, 1, 0, 0, 0], object=1)
    report = judge(write_shard(tmp_path / "s.h5", [case[1] for case in cases] + [clash, plate, row()]))
    found = _failed(report)
    assert {name: got for (name, _, _), got in zip(cases, found, strict=False)} == {name: w for name, _, w in cases}
    assert report.values["penetration_mm"][0] == pytest.approx(5.0, abs=1e-3)
    one_sided = [case[0] for case in cases].index("one-sided")
    assert report.values["residual"][one_sided] == pytest.approx(1.0, abs=1e-6)
    assert report.values["force_balance"][one_sided] == pytest.approx(1.0, abs=1e-6)
    assert "self_penetration" in found[-3]
    assert report.values["self_penetration_mm"][-3] == pytest.approx(6.0, abs=1e-3)
    assert report.self_pairs == {"left x right": 1}
    assert "penetration" in found[-2]
    assert report.values["link_in_object_mm"][-2] <= 1.5 + 1e-3
    assert report.values["object_in_link_mm"][-2] == pytest.approx(5.0, abs=0.2)
    assert found[-1] == set()
    assert report.valid.sum() == 1
    assert set().union(*found) == set(CHECKS) - OF_SEVERAL - OF_TABLES - OF_REGIONS - {"steered", "pregrasp", "closing"}


def test_original_files_override_the_shard(tmp_path: Path) -> None:
    shard = write_shard(tmp_path / "s.h5", [row(), row(q=[0.025, 0.025, 0.31], follow=0.165)])
    (tmp_path / "hand" / "meshes").mkdir(parents=True)
    urdf = tmp_path / "hand" / "jaws.urdf"
    urdf.write_text(URDF.replace('upper="0.06"', 'upper="0.02"'))
    JAW.export(tmp_path / "hand" / "meshes" / "jaw.obj")
    bigger = CUBE.copy()
    bigger.apply_scale(1.3)  # 6 mm into each jaw
    bigger.export(tmp_path / "big.obj")
    assert judge(shard).passed
    assert judge(shard, rows=1).rows == 1
    again = shutil.copy(shard, tmp_path / "t.h5")
    mesh = f"a_cube={tmp_path / 'big.obj'}"
    asked = ["judge", str(shard), str(again), "--urdf", str(urdf), "--mesh", mesh, "--json", "-"]
    result = CliRunner().invoke(app, asked)
    assert result.exit_code == 1
    out = json.loads(result.stdout)
    assert out["failures"]["limits"] == {"rows": 4, "worst": pytest.approx(0.005), "bound": 1e-4}
    assert out["failures"]["penetration"]["rows"] == 4
    assert [s["valid_rows"] for s in out["shards"]] == [0, 0]
    assert out["total_rows"] == 4
    assert out["near_duplicates"] == 3
    assert out["distinct_object_poses"] == 1


def test_object_against_object() -> None:
    one, two = JudgedObject(CUBE), JudgedObject(PLATE)
    T = np.eye(4)[None].repeat(2, axis=0)
    T[0, :3, 3] = [0, 0, 0.02 + 0.0015 - 0.001]
    T[1, :3, 3] = [0, 0, 0.02 + 0.0015 + 0.001]
    assert object_in_object(one, two, T) == pytest.approx([1e-3, 0.0], abs=1e-6)


# Two pairs of prismatic jaws side by side over a palm, each pair for one object.
PAIRS = """<robot name="pairs">
  <link name="palm"><collision><origin xyz="0.03 0 -0.02"/>
    <geometry><box size="0.2 0.12 0.02"/></geometry></collision></link>"""
for _name, _x, _sign in (("a", 0.0, 1), ("b", 0.0, -1), ("c", 0.06, 1), ("d", 0.06, -1)):
    PAIRS += f"""
  <link name="{_name}"><collision><origin xyz="0 0 0.03"/>
    <geometry><box size="0.02 0.01 0.06"/></geometry></collision></link>
  <joint name="slide_{_name}" type="prismatic"><parent link="palm"/><child link="{_name}"/><origin xyz="{_x} 0 0"/>
    <axis xyz="0 {_sign} 0"/><limit lower="0" upper="0.06" effort="1" velocity="1"/></joint>"""
PAIRS += "</robot>"


def _sequence(path: Path, **changes: Callable[[dict[str, np.ndarray]], None]) -> Path:
    """Two cubes: row 0 takes one with the first pair, rows 1 and on extend it by another in the second pair."""
    n = 2 + len(changes)
    shut, wide = 0.025, 0.05
    q = np.full((n, 2, 4), [[shut, shut, wide, wide], [shut] * 4])
    squeeze = np.full((n, 2, 4), [[0.02, 0.02, wide, wide], [0.02] * 4])
    pose = np.full((n, 2, 7), [[0, 0, 0.035, 1, 0, 0, 0], [0.06, 0, 0.035, 1, 0, 0, 0]])
    points = np.full((n, 2, 2, 3), [[0, 0.02, 0.001], [0, -0.02, 0.001]])
    normals = np.full((n, 2, 2, 3), [[0, 1, 0], [0, -1, 0]])
    values: dict[str, np.ndarray] = {
        "object_pose": pose.astype("f4"),
        "object_index": np.zeros((n, 2), "i4"),
        "contact_points": points.astype("f4"),
        "contact_normals": normals.astype("f4"),
        "contact_forces": (-normals / 2).astype("f4"),
        "contact_links": np.full((n, 2, 2), [[1, 2], [3, 4]], "i2"),
        "sequence/q": q.astype("f4"),
        "sequence/q_pregrasp": q.astype("f4"),
        "sequence/q_squeeze": squeeze.astype("f4"),
        "sequence/space": np.full((n, 2), [0, 1], "i2"),
        "sequence/free_joints": np.full((n, 2, 4), [[True, True, False, False], [False, False, True, True]]),
        "sequence/parent": np.array([-1, *[0] * (n - 1)]),
    }
    for value in values.values():  # the first row has but one object
        if value.ndim > 1:
            value[0, 1] = {"f": np.nan, "i": -1, "b": False}[value.dtype.kind]
    for at, change in enumerate(changes.values(), 2):
        change({name: value[at : at + 1] for name, value in values.items()})
    held = (values["object_index"] >= 0).sum(1)
    for name in ("q", "q_pregrasp", "q_squeeze"):
        values[name] = values[f"sequence/{name}"][np.arange(n), held - 1]
    with h5py.File(path, "w") as f:
        f.attrs["format"], f.attrs["format_version"], f.attrs["complete"] = "lgrasp-shard", "1.0", 1
        f.create_group("hand").attrs["base_link"] = "palm"
        f["hand/urdf"] = PAIRS
        f["hand/joint_names"] = [f"slide_{k}" for k in "abcd"]
        f["hand/link_names"] = ["palm", *"abcd"]
        group = f.create_group("objects/cube")
        group["vertices"], group["faces"] = CUBE.vertices.astype("f4"), CUBE.faces.astype("i4")
        for name, value in values.items():
            f[f"grasps/{name}"] = value
    return path


def _put(name: str, where: Any, value: Any) -> Callable[[dict[str, np.ndarray]], None]:
    def change(row: dict[str, np.ndarray]) -> None:
        row[name][(0, *where)] = value

    return change


def _closer(row: dict[str, np.ndarray]) -> None:
    """The second cube 3 mm into the first, still between its jaws."""
    row["object_pose"][0, 1, 0] = 0.037
    row["contact_points"][0, 1, :, 0] = 0.0195


def _same_joint(row: dict[str, np.ndarray]) -> None:
    """The second step moves a jaw that holds the first cube, and says so."""
    row["sequence/free_joints"][0, :, 1] = [False, True]
    row["sequence/q"][0, 1, 1] += 1e-4


def test_sequences(tmp_path: Path) -> None:
    """What is planted in rows of two objects is found, and rows of fewer and more are counted apart."""
    cases = {
        "loose": (_put("sequence/q", (1, slice(2, 4)), 0.03), {"contact_on_link"}),
        "first_loose": (_put("sequence/q", (slice(0, 2), 0), 0.03), {"contact_on_link", "parent", "frozen"}),
        "overlap": (_closer, {"object_object"}),
        "creep": (_put("sequence/q", (1, 0), 0.02501), {"frozen"}),
        "pregrasp": (_put("sequence/q_pregrasp", (1, 1), 0.03), {"frozen"}),
        "let_go": (_put("sequence/q_squeeze", (1, 0), 0.025), {"frozen"}),
        "twice": (_put("sequence/free_joints", (1, 0), True), {"frozen"}),
        "carried": (_same_joint, {"frozen", "parent"}),
        "orphan": (_put("sequence/parent", (), -1), {"parent"}),
        "ahead": (_put("sequence/parent", (), 15), {"parent"}),
        "other": (_put("object_pose", (0, 2), 0.0351), {"parent"}),
        "space": (_put("sequence/space", (1,), 0), {"parent"}),
        "one_sided": (_put("contact_links", (1, 1), -1), {"residual", "forces"}),
    }
    _sequence(tmp_path / "s.h5", **{name: change for name, (change, _) in cases.items()})
    report = judge(tmp_path)
    found = _failed(report)
    assert found[:2] == [set(), set()]
    assert dict(zip(cases, found[2:], strict=True)) == {name: wanted for name, (_, wanted) in cases.items()}
    assert {k: (d["rows"], d["valid"]) for k, d in report.by_objects.items()} == {1: (1, 1), 2: (14, 1)}
    assert report.by_objects[2]["objects max"] == pytest.approx(np.nanmax(report.values["object_object_mm"]))
    assert report.values["object_object_mm"][4] == pytest.approx(3.0, abs=1e-3)
    assert "objects held" in str(report)
    assert set().union(*found) >= OF_SEVERAL


def test_which_joints_carry_a_link() -> None:
    blob = str(JAW.export(file_type="obj")).encode()
    resolve = _resolver({"package://jaws/meshes/jaw.obj": blob}, None)
    names = ["slide_left", "slide_right", "swing"]
    moves = JudgedHand(URDF, resolve).riders(names)
    assert moves.sum() == 5  # a jaw by its slide, a jaw by its slide, thumb, tip and lever by the swing
    assert [names[k] for k in moves.argmax(axis=0)[1:]] == ["slide_left", "slide_right", "swing", "swing", "swing"]
    seen = JudgedHand(URDF, resolve, "tip").riders(names)  # from the tip all else swings
    assert seen[2].tolist() == [True, True, True, False, False, True]
