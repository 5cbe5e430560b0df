"""hand.yaml: bad keys and values, and finding a hand by what a user would type."""

import re
import shutil
from pathlib import Path

import pytest
import yaml
from support.fresh import loaded
from support.hands import REAL, minimal_spec
from support.places import ROOT

from lgrasp.errors import HandError
from lgrasp.hand.build import build_hand
from lgrasp.hand.digest import hand_digest
from lgrasp.hand.find import find_hand
from lgrasp.hand.names import known_hands
from lgrasp.hand.spec import HandSpec, load_spec
from lgrasp.hand.spec_check import check_contact_links, open_posture_notes
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import read_urdf

SHIPPED = ROOT / "hands" / "allegro"
LAUGHS = "a0: &a0 [ha]\n" + "".join(f"a{i}: &a{i} [{', '.join(10 * [f'*a{i - 1}'])}]\n" for i in range(1, 12))

CHANGES = {
    "unknown key": ({"palms": {}}, "unknown key 'palms'.*'palm'"),
    "unknown key inside": ({"contact": [{"links": ["x"], "forbiden": []}]}, "contact.0.forbiden.*'forbidden'"),
    "no contact": ({"contact": []}, "contact"),
    "contact without links": ({"contact": [{"links": []}]}, "contact.0.links"),
    "contact is text": ({"contact": "link_3.0_tip"}, "contact"),
    "zero axis": ({"contact": [{"links": ["x"], "forbidden": [{"axis": [0, 0, 0], "angle": 30}]}]}, "axis.*zero"),
    "axis not finite": ({"palm": {"allowed": [{"axis": [0, 0, float("nan")], "angle": 30}]}}, "axis.*finite"),
    "two-number axis": ({"palm": {"allowed": [{"axis": [0, 1], "angle": 30}]}}, "axis"),
    "negative angle": ({"palm": {"allowed": [{"axis": [0, 0, 1], "angle": -5}]}}, "angle.*greater than 0"),
    "angle in radians squared": ({"palm": {"allowed": [{"axis": [0, 0, 1], "angle": 361}]}}, "angle.*180"),
    "box turned over": ({"canonical_box": {"min": [0, 0, 0], "max": [0.1, -0.1, 0.1]}}, "min.*below max"),
    "box without max": ({"canonical_box": {"min": [0, 0, 0]}}, "canonical_box.max"),
    "posture is text": ({"open_posture": {"joint_0.0": "half"}}, "open_posture.joint_0.0"),
    "posture not finite": ({"open_posture": {"joint_0.0": float("inf")}}, "open_posture.joint_0.0.*finite"),
    "locked is a list": ({"locked": ["joint_0.0"]}, "locked"),
    "no contacts": ({"contacts": [3, 0]}, "contacts.1.*greater than or equal to 1"),
    "negative contacts": ({"contacts": [-2]}, "contacts.0.*greater than or equal to 1"),
    "contacts in excess": ({"contacts": 17 * [3]}, "contacts.*at most 16"),
    "empty name": ({"name": ""}, "name"),
    "name is a list": ({"name": ["a", "b"]}, "name"),
}
MISFITS = {
    "locked joint": ({"locked": {"joint_99.0": 0.0}}, "'joint_99.0' is not a movable joint"),
    "locked outside": ({"locked": {"joint_0.0": 9.0}}, "outside its limits"),
    "base link": ({"base_link": "nowhere"}, "base_link 'nowhere'"),
    "moving base": ({"base_link": "link_3.0"}, "name a static link"),
    "posture": ({"open_posture": {"joint_99.0": 0.0}}, "open_posture.*'joint_99.0'"),
    "static link": ({"static_links": ["nowhere"]}, "'nowhere'.*not a link"),
    "finger": ({"fingers": {"index": ["nowhere"]}}, "'nowhere'.*not a link"),
    "contact link": ({"contact": [{"links": ["nowhere"]}]}, "'nowhere' does not exist"),
    "contact twice": ({"contact": [{"links": ["link_3.0_tip"]}, {"links": ["link_3.0_tip"]}]}, "name it once"),
    "contact without solid": ({"contact": [{"links": ["wrist"]}]}, "no collision geometry"),
    "palm under contact": ({"contact": [{"links": ["base_link"]}], "palm": {}}, "list it under palm"),
    "contact under palm": ({"palm": {"links": ["link_3.0"]}}, "list it under contact"),
    "nothing left": (
        {"contact": [{"links": ["link_3.0_tip"], "forbidden": [{"axis": [1, 0, 0], "angle": 180}]}]},
        "leave no surface",
    ),
}


def write(folder: Path, changes: dict) -> Path:
    path = folder / "hand.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load((SHIPPED / "hand.yaml").read_text()) | changes))
    return path


def refused(call, path: Path | str, expected: str) -> None:
    with pytest.raises(HandError) as caught:
        call()
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 1200
    assert re.search(expected, message), message


@pytest.mark.parametrize("name", CHANGES)
def test_bad_value(name, tmp_path):
    changes, expected = CHANGES[name]
    path = write(tmp_path, changes)
    refused(lambda: load_spec(path), path, expected)


@pytest.mark.parametrize("name", MISFITS)
def test_rules_that_do_not_fit_the_urdf(name, tmp_path):
    changes, expected = MISFITS[name]
    spec = load_spec(write(tmp_path, changes))
    refused(lambda: build_hand(SHIPPED / "hand.urdf", spec), "allegro", expected)


@pytest.mark.parametrize(
    "content",
    [b"", b"- a\n- b\n", b"text", b"{", b"\xff\xfe\x00", b"a: \x07", b"!!python/object/apply:os.getcwd []",
     b"when: 2001-99-99", 20000 * b"[", b"name: &a [*a]\ncontact: *a"],
)  # fmt: skip
def test_bad_yaml(content, tmp_path):
    path = tmp_path / "hand.yaml"
    path.write_bytes(content)
    refused(lambda: load_spec(path), path, "")


def test_nested_aliases_do_not_blow_up(tmp_path):
    path = tmp_path / "hand.yaml"
    path.write_text(LAUGHS + "name: *a11\ncontact: *a11\n")
    refused(lambda: load_spec(path), path, "")
    path.write_text("x: &x\n" + LAUGHS.replace("a0:", " a0:").replace("\na", "\n a") + "name: *a11\n")
    refused(lambda: load_spec(path), path, "")


def test_shipped_rules_load():
    spec = load_spec(SHIPPED / "hand.yaml")
    check_contact_links(
        spec, tuple(read_urdf(SHIPPED / "hand.urdf").links), dict(read_urdf(SHIPPED / "hand.urdf").links)
    )
    assert spec.approximation
    assert HandSpec.model_validate(spec.model_dump()) == spec.model_copy(update={"approximation": ""})


def test_digest_follows_urdf_meshes_and_rules(tmp_path):
    spec = load_spec(SHIPPED / "hand.yaml")
    urdf = tmp_path / "hand.urdf"
    shutil.copy(SHIPPED / "hand.urdf", urdf)
    first = hand_digest(urdf, spec)
    assert first == hand_digest(SHIPPED / "hand.urdf", spec)
    assert first != hand_digest(urdf, spec.model_copy(update={"open_posture": {}}))
    urdf.write_text(urdf.read_text() + "<!-- -->")
    assert first != hand_digest(urdf, spec)


# finding


@pytest.fixture
def library(tmp_path, monkeypatch) -> Path:
    """A search path with one hand of the user's own."""
    folder = tmp_path / "hands" / "mine"
    folder.mkdir(parents=True)
    for name in ("hand.urdf", "hand.yaml"):
        shutil.copy(SHIPPED / name, folder)
    monkeypatch.setenv("LGRASP_PATH", str(tmp_path))
    return folder


def test_find_by_name_and_path(library):
    assert {"allegro", "mine"} <= set(known_hands())
    assert find_hand("allegro").urdf.samefile(SHIPPED / "hand.urdf")
    assert find_hand("mine").urdf == library / "hand.urdf"
    assert find_hand(str(library)).urdf == library / "hand.urdf"
    assert find_hand(str(library / "hand.urdf")).spec == find_hand("allegro").spec


def test_own_hand_wins_over_the_shipped_one(library):
    library.rename(library.with_name("allegro"))
    assert find_hand("allegro").urdf == library.with_name("allegro") / "hand.urdf"


def test_urdf_with_the_names_of_a_known_hand(tmp_path):
    path = tmp_path / "my_copy.urdf"
    shutil.copy(SHIPPED / "hand.urdf", path)
    source = find_hand(str(path))
    assert source.urdf == path
    assert source.name == source.spec.name == "my_copy"
    assert source.known == "allegro"
    assert "known hand 'allegro'" in source.note
    assert "elsewhere" not in source.note
    path.write_text(path.read_text().replace('xyz="0 0 0.054"', 'xyz="0 0 0.084"'))
    source = find_hand(str(path))
    assert source.known == ""
    assert "joints are up to 30 mm elsewhere" in source.note
    shutil.copy(SHIPPED / "hand.urdf", path)
    path.write_text(re.sub(r'(type="revolute">.*?rpy=")[^"]*', r"\1 0 3 0", path.read_text(), count=1, flags=re.DOTALL))
    source = find_hand(str(path))
    assert source.known == ""
    assert "links are turned by up to 172°" in source.note


def test_nearest_of_the_known_hands_with_its_names(library, tmp_path):
    """A hand of the user's own comes first on the search path, but has its joints elsewhere, or turned."""
    path, own = tmp_path / "copy.urdf", library / "hand.urdf"
    shutil.copy(SHIPPED / "hand.urdf", path)
    own.write_text(own.read_text().replace('xyz="0 0 0.054"', 'xyz="0 0 0.056"'))
    assert find_hand(str(path)).known == "allegro"
    own.write_text(re.sub(r'(type="revolute">.*?rpy=")[^"]*', r"\1 0 3 0", path.read_text(), count=1, flags=re.DOTALL))
    path.write_text(path.read_text().replace('xyz="0 0 0.054"', 'xyz="0 0 0.056"'))
    assert find_hand(str(path)).known == "allegro"


@pytest.mark.skipif(
    not (REAL / "allegro" / "allegro.urdf").is_file(), reason="the real Allegro is not at ../shared/assets/hands"
)
def test_real_allegro_takes_the_shipped_rules():
    """Not what they say of the shipped files: their licence is not that of these meshes."""
    source = find_hand(str(REAL / "allegro" / "allegro.urdf"))
    unsaid = dict.fromkeys(("approximation", "licence", "source", "notes"), "")
    assert source.spec == find_hand("allegro").spec.model_copy(update=unsaid)
    assert "known hand 'allegro'" in source.note


def test_broken_neighbour_does_not_hide_a_known_hand(library):
    (library / "hand.urdf").write_text("broken")
    path = library.parent / "other.urdf"
    shutil.copy(SHIPPED / "hand.urdf", path)
    assert find_hand(str(path)).known == "allegro"


def test_unknown_hands(library, tmp_path):
    refused(lambda: find_hand("alegro"), "alegro", "did you mean 'allegro'")
    refused(lambda: find_hand("zzz"), "zzz", "known hands: .*allegro")
    refused(lambda: find_hand("no/such/hand.urdf"), "no/such/hand.urdf", "does not exist")
    refused(lambda: find_hand(str(tmp_path)), tmp_path, "no hand.yaml")
    other = tmp_path / "other.urdf"
    other.write_text((SHIPPED / "hand.urdf").read_text().replace("joint_0.0", "joint_x"))
    refused(lambda: find_hand(str(other)), other, "lgrasp hands add")


def test_hand_without_solids(tmp_path):
    path = tmp_path / "bare.urdf"
    path.write_text(
        '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="revolute"><parent link="a"/>'
        '<child link="b"/><limit lower="0" upper="1"/></joint></robot>'
    )
    refused(lambda: build_hand(path, minimal_spec("bare", ["b"])), "bare", "no collision geometry")
    refused(
        lambda: build_tree(read_urdf(path), minimal_spec("bare", ["b"], locked={"j": 0.5})), path, "every joint.*locked"
    )


def test_a_hand_is_found_without_drafting():
    code = "from lgrasp.jobs.hands import hand_source; hand_source('allegro')"
    assert loaded(code, ["lgrasp.hand.drafting"]) == []


def test_values_of_the_open_posture_that_are_not_taken_are_told():
    source = find_hand("barrett")
    tree = build_tree(read_urdf(source.urdf), source.spec)
    assert open_posture_notes(source.spec, tree) == []
    follower = next(j.name for j in read_urdf(source.urdf).joints if j.mimic)
    spec = source.spec.model_copy(update={"open_posture": {"finger_1_med_joint": -30.0, follower: 0.0}})
    assert open_posture_notes(spec, tree) == [
        "open_posture: 'finger_1_med_joint' = -30 is outside [-2.44, 0] and counts as -2.44",
        f"open_posture: '{follower}' = 0 counts for nothing, the joint is locked or mimics another",
    ]
