"""Opposition spaces that are proposed for a hand: an author's on Allegro, and what is dropped, with the reason."""

import numpy as np
import pytest
from support.hands import REAL
from support.places import ROOT
from support.urdfs import fingers, gripper, turned

from lgrasp.hand.drafting.draft import draft_spec
from lgrasp.hand.drafting.import_urdf import import_urdf
from lgrasp.hand.drafting.lateral_surfaces import Beside, finger_rows
from lgrasp.hand.drafting.write import write_spec
from lgrasp.hand.opposition.spaces import hand_spaces
from lgrasp.hand.spec import HandSpec, OppositionSpace, load_spec
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import read_urdf

ALLEGRO = ROOT / "hands" / "allegro" / "hand.urdf"
# its URDF does not say which finger is which
NAMES = {"finger_1": "index", "finger_2": "middle", "finger_3": "ring", "finger_4": "thumb"}


def surfaces(space: OppositionSpace) -> set[frozenset]:
    """Both sides as (link, axis), whatever their order."""
    return {
        frozenset((link, tuple(np.round(part.axis, 1))) for part in side for link in part.links) for side in space.sides
    }


def test_allegro_is_proposed_the_spaces_of_its_author(allegro):
    spec, said = allegro
    author = load_spec(ALLEGRO.parent / "hand.yaml").opposition_spaces
    found = {}
    for name, space in spec.opposition_spaces.items():
        a, b = (NAMES.get(part, part) for part in name.split("-"))
        found[f"{b}-{a}" if b == "thumb" else f"{a}-{b}"] = space
    assert set(found) == {*author, "thumb-middle", "thumb-ring"}
    for name, space in author.items():
        assert set(found[name].joints) == set(space.joints), name
        assert surfaces(found[name]) == surfaces(space), name
    # the thumb presses on the part of the palm below the index finger, as the author says
    boxes = {name: found[name].sides[0][0].box for name in found if name.endswith("palm")}
    assert boxes["thumb-palm"] == boxes["index-palm"]
    edges = [[boxes[f"{f}-palm"].min[1], boxes[f"{f}-palm"].max[1]] for f in ("ring", "middle", "index")]
    assert edges == sorted(edges)
    assert [edges[0][1], edges[1][1]] == [edges[1][0], edges[2][0]]
    assert any("opposition spaces" in line and "mm" in line for line in said)


def test_a_left_hand_on_another_base_gets_the_mirror_image(allegro, tmp_path):
    path = turned(ALLEGRO, tmp_path, "1.1 -0.7 2.3", mirror=True)
    left, own = draft_spec(path, "turned")[0], allegro[0]
    assert left.base_link == "mount"
    assert {link for rule in left.contact for link in rule.links} == {
        link for rule in own.contact for link in rule.links
    }
    assert left.palm.links == own.palm.links
    assert np.allclose(left.palm.allowed[0].axis, [-x for x in own.palm.allowed[0].axis], atol=0.05)
    right, mirrored_spaces = own.opposition_spaces, left.opposition_spaces
    assert list(mirrored_spaces) == list(right)
    for name, space in right.items():
        for side, other in zip(space.sides, mirrored_spaces[name].sides, strict=True):
            # x to -x: palmar surface looks the other way, lateral surface does not
            mirrored = [(part.links, (-part.axis[0] + 0.0, *part.axis[1:])) for part in side]
            assert [(part.links, part.axis) for part in other] == mirrored, name


def test_jaws_get_one_space_and_the_rest_is_dropped_with_the_reason(tmp_path):
    spec, said = draft_spec(gripper(tmp_path))
    assert list(spec.opposition_spaces) == ["finger_1-finger_2"]
    assert set(spec.opposition_spaces["finger_1-finger_2"].joints) == {"l", "r"}
    assert any("no opposition space finger_1-palm, finger_2-palm: its sides never face" in line for line in said)
    # one jaw made the base: the other closes against it as against a palm
    made = import_urdf(gripper(tmp_path, mimic=True), out=tmp_path / "made").spec
    (space,) = made.opposition_spaces.values()
    assert len(space.joints) == 1
    assert {link for side in space.sides for part in side for link in part.links} == {"jaw_l", "jaw_r"}


def test_fingers_close_against_each_other_and_the_palm(tmp_path):
    path = fingers(tmp_path, 2)
    spec, _ = draft_spec(path)
    tree = build_tree(read_urdf(path), spec)
    spaces = {s.name: s for s in hand_spaces(spec, tree)}
    assert {name.count("palm") for name in spaces} == {0, 1}
    for name, space in spaces.items():
        assert space.joints.sum() == (2 if "palm" in name else 4)
    # pads are on the inner sides: fingers stand at y = +-40 mm and bend towards each other
    for side in spec.opposition_spaces["finger_1-finger_2"].sides:
        (part,) = side
        group = int(tree.body_group[tree.link_body[tree.link_names.index(part.links[0])]])
        root = tree.T_parent_joint[tree.joint_first[group]]
        assert part.axis[1] * root[1, 3] < 0


def test_written_spaces_are_read_back(tmp_path):
    """hand.yaml holds what was proposed, sides of several surfaces included."""
    part = {"links": ["b0"], "axis": [0, 0.6, -0.8], "angle": 30}
    boxed = {"links": ["base"], "axis": [0, 0, 1], "angle": 45, "box": {"min": [-1, -0.01, 0], "max": [1, 0.02, 0.5]}}
    spec, _ = draft_spec(fingers(tmp_path, 2))
    mixed = {"joints": ["j0"], "sides": [[part, part | {"links": ["a0"]}], boxed]}
    spec = HandSpec.model_validate(spec.model_dump() | {"opposition_spaces": {"mixed": mixed, "2": mixed}})
    write_spec(spec, tmp_path / "hand.yaml", ["said"])
    assert load_spec(tmp_path / "hand.yaml") == spec


def test_rows_of_fingers():
    """A row from end to end, whatever the order of its pairs; a ring has no end."""
    row: set[Beside] = {("b", 1, "c", -1), ("a", 1, "b", -1)}
    assert finger_rows(["c", "t", "a", "b"], row) == [["c", "b", "a"]]
    assert finger_rows(["a", "b", "c"], {*row, ("c", 1, "a", -1)}) == []
    assert finger_rows(["a", "b", "c", "d"], {("a", 1, "b", 1), ("d", 1, "c", 1)}) == [["a", "b"], ["c", "d"]]


def test_a_real_hand_gets_spaces_for_every_finger():
    path = REAL / "shadow" / "shadow.urdf"
    if not path.is_file():
        pytest.skip("the real hand is not at ../shared/assets/hands/shadow")
    spec, said = draft_spec(path, "shadow")
    spaces = hand_spaces(spec, build_tree(read_urdf(path), spec))
    assert {g for s in spaces for g in s.groups} == {-1, *range(len(spec.fingers))}
    pairs = ["index-middle", "middle-ring", "ring-little"]
    digits = ["index", "middle", "ring", "little"]
    expected = {f"{d}-palm" for d in [*digits, "thumb"]} | {f"thumb-{d}" for d in digits} | set(pairs)
    assert {s.name for s in spaces} == expected
    assert not any("opposition spaces: none" in line for line in said)
