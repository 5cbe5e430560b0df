"""Grasp types in the words of a hand."""

import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.places import ROOT

from lgrasp.choices import ThumbPlace
from lgrasp.errors import ConfigError, HandError
from lgrasp.hand.find import find_hand
from lgrasp.hand.fingers import finger_roles, roles_by_opposition
from lgrasp.hand.sides import posture_links
from lgrasp.hand.spec import load_spec
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import read_urdf
from lgrasp.steer.grasp_types import type_names
from lgrasp.steer.params import Steering
from lgrasp.steer.typed import Anatomy, asked_sides, asked_thumb, made_types, typed

HANDS = ("shadow", "barrett")


@cache
def parts(name):
    """What types ask of a hand."""
    source = find_hand(name)
    urdf = read_urdf(source.urdf)
    return Anatomy(source.spec, urdf, build_tree(urdf, source.spec))


@pytest.mark.parametrize("name", HANDS)
def test_every_type_is_made_or_refused_by_what_is_missing(name):
    hand = parts(name)
    made = made_types(hand)
    contact = {link for rule in hand.spec.contact for link in rule.links} | set(hand.spec.palm.links)
    kinds = []
    for kind in type_names():
        if kind in made.cannot:
            with pytest.raises(ConfigError, match=f"grasp type {kind}: hand '{name}' has no ") as error:
                typed(Steering(grasp_type=kind), hand)
            assert "\n" not in str(error.value)
        else:
            found = typed(Steering(grasp_type=kind), hand)
            assert len(found.fingers) + (found.palm == "must") >= 2
            assert set(found.fingers) <= set(hand.spec.fingers)
            assert {link for link, side in found.sides.items() if side is None} <= contact
            assert [(side.link, side.side) for side in asked_sides(found, hand)] == [
                (link, side) for link, side in found.sides.items() if side
            ]
            assert typed(found, hand) == found
            if kind in made.makes:
                kinds.append(found.model_copy(update={"grasp_type": None}))
    assert len(set(kinds)) == len(kinds) == len(made.makes)  # types with the same contacts are told together
    assert sorted([*made.makes, *sum(made.makes.values(), ()), *made.cannot]) == sorted(type_names())


def test_the_taxonomy_is_whole():
    assert len(type_names()) == 33
    with pytest.raises(ConfigError, match="unknown grasp type 'tripot'; did you mean 'tripod'"):
        Steering(grasp_type="tripot")


def test_a_tripod_of_shadow():
    found = typed(Steering(grasp_type="tripod"), parts("shadow"))
    assert found.fingers == ("thumb", "index", "middle")
    assert found.links == ("thdistal", "ffdistal", "mfdistal")
    assert found.palm == "no"
    assert typed(Steering(grasp_type="sphere-3-finger"), parts("shadow")).links == ()


def test_a_lateral_grasp_of_shadow():
    found = typed(Steering(grasp_type="lateral"), parts("shadow"))
    assert found.links == ("thdistal", "ffmiddle:radial", "ffdistal:radial")
    assert {side.axis for side in asked_sides(found, parts("shadow"))} == {(1.0, 0.0, 0.0)}


@pytest.mark.parametrize("name", ["allegro", "leap", "shadow"])
def test_the_fingers_of_a_hand_face_each_other_as_its_rules_say(name):
    """The opposition space of index and middle finger was written by hand: one's ulnar, the other's radial side."""
    hand = parts(name)
    ulnar, radial = hand.spec.opposition_spaces["index-middle"].sides
    axes = {link: own["ulnar"].axis for link, own in hand.sides["index"].items()}
    axes |= {link: own["radial"].axis for link, own in hand.sides["middle"].items()}
    for part in (*ulnar, *radial):
        for link in part.links:
            np.testing.assert_allclose(axes[link], part.axis, atol=0.02)


@pytest.mark.parametrize(
    ("name", "links", "axis"), [("allegro", 4, (0, 0, 1)), ("shadow", 5, (0, 0, 1)), ("leap", 4, (0, -1, 0))]
)
def test_tips_look_along_their_fingers(name, links, axis):
    """By the frames of the makers' URDFs."""
    sides = [side for own in parts(name).sides.values() for found in own.values() for side in found.values()]
    assert [side.axis for side in sides if side.side == "tip"] == links * [axis]


@pytest.mark.parametrize(
    ("name", "joint", "adducted", "abducted"),
    [
        ("allegro", "joint_12.0", 0.27, 1.39),
        ("shadow", "THJ4", 0.0, 1.2),
        ("leap", "12", 0.0, 1.5),
    ],
)
def test_the_joint_that_opposes_a_thumb_abducts_it(name, joint, adducted, abducted):
    hand = parts(name)
    source = find_hand(name)
    places: dict[ThumbPlace, float] = {"adducted": adducted, "abducted": abducted}
    for place, value in places.items():
        bend, q = hand.thumb[place], hand.tree.joint_open[None].copy()
        q[0, hand.tree.joint_names.index(joint)] = value
        T = posture_links(read_urdf(source.urdf), hand.tree, q)[bend.link][0]
        angle = np.degrees(np.arccos(abs(T[:3, :3] @ bend.axis @ bend.normal)))
        assert (angle < bend.angle) == (place == "adducted")


def test_types_ask_for_the_thumb_of_hands_that_abduct_it():
    for name, kind, thumb in (
        ("allegro", "adducted-thumb", "adducted"),
        ("allegro", "medium-wrap", "abducted"),
        ("leap", "lateral", "adducted"),
        ("shadow", "adduction-grip", "abducted"),
        ("barrett", "tripod", None),
        ("dclaw", "tripod", None),
    ):
        found = typed(Steering(grasp_type=kind), parts(name))
        assert found.thumb == thumb
        bend = asked_thumb(found, parts(name))
        assert (bend and bend.place) == thumb


@pytest.mark.parametrize("name", ["barrett", "schunk_svh", "dclaw"])
def test_a_thumb_without_places_is_told(name):
    """Barrett's always bends across the palm, Schunk's turns by 10 degrees only, DClaw's fingers stand in no row."""
    with pytest.raises(ConfigError, match=f"steer.thumb: hand '{name}' has no thumb that is abducted and adducted"):
        asked_thumb(Steering(thumb="abducted"), parts(name))


def test_links_without_sides_are_told():
    for name, link, words in (
        ("allegro", "link_15.0_tip", "'allegro' has no side 'radial'; links that have: link_0.0, link_1.0"),
        ("dclaw", "link_f2_3", "'dclaw' has no side 'radial'; links that have: none"),
    ):
        with pytest.raises(ConfigError, match=f"steer.links: link '{link}' of hand {words}"):
            asked_sides(Steering(links=(f"{link}:radial",)), parts(name))


@pytest.mark.parametrize(
    "asked", [{"fingers": "thumb,ring"}, {"links": "link_3.0_tip"}, {"palm": "must"}, {"thumb": "adducted"}]
)
def test_what_touches_is_told_once(asked):
    with pytest.raises(ConfigError, match=f"grasp type tripod says what touches: leave out steer.{next(iter(asked))}"):
        typed(Steering(grasp_type="tripod", **asked), parts("allegro"))


def test_roles_of_hand_yaml_and_of_names(tmp_path: Path):
    assert {role: finger for role, (finger, _) in parts("barrett").roles.items()} == {
        "thumb": "three",
        "index": "one",
        "middle": "two",
    }
    folder = shutil.copytree(ROOT / "hands" / "allegro", tmp_path / "own")
    data = yaml.safe_load((folder / "hand.yaml").read_text())

    def write(**changes):
        (folder / "hand.yaml").write_text(yaml.safe_dump(data | changes))
        return folder / "hand.yaml"

    tree = parts("allegro").tree
    renamed = dict(zip(["rh_ffdistal", "rh_b", "rh_c", "rh_thumb_tip"], data["fingers"].values(), strict=True))
    spec = load_spec(write(fingers=renamed))
    assert [finger for finger, _ in finger_roles(spec, tree).values()] == list(
        map(list(renamed).__getitem__, (3, 0, 1, 2))
    )
    unnamed = finger_roles(load_spec(write(fingers={})), tree)
    assert list(unnamed) == ["thumb", "index", "middle", "ring"]
    for roles, problem in (
        ({"pinky": "little"}, "roles.*'pinky' is none of fingers"),
        ({"index": "ring", "middle": "ring"}, "two fingers are 'ring'"),
        ({"index": "second"}, "roles.index.*'thumb'"),
    ):
        with pytest.raises(HandError, match=problem):
            load_spec(write(roles=roles))


def test_the_thumb_of_fingers_without_names_opposes_the_others():
    """As of hands whose links have numbers: the thumb is not the finger that comes first, nor the index."""
    spec, tree = parts("allegro").spec, parts("allegro").tree
    names = dict(zip(["one", "two", "three", "four"], spec.fingers.values(), strict=True))
    pairs = dict(spec.opposition_spaces)
    thumb = pairs["thumb-palm"].sides[1]
    for finger in ("middle", "ring"):  # as a draft has them
        sides = thumb, pairs[f"{finger}-palm"].sides[1]
        pairs[f"thumb-{finger}"] = pairs["thumb-index"].model_copy(update={"sides": sides})
    known = spec.model_copy(update={"fingers": names, "opposition_spaces": pairs, "roles": {}})
    roles = roles_by_opposition(known)
    assert roles == {"four": "thumb", "three": "index", "two": "middle", "one": "ring"}
    acting = finger_roles(known.model_copy(update={"roles": roles}), tree)
    assert {role: finger for role, (finger, _) in acting.items()} == {role: finger for finger, role in roles.items()}
    assert roles_by_opposition(spec) == {}  # a name tells it
    some = {name: space for name, space in pairs.items() if "thumb" not in name}
    assert roles_by_opposition(known.model_copy(update={"opposition_spaces": some})) == {}
