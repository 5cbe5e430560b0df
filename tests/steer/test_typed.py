"""Grasp types in the words of a hand."""

import shutil
from pathlib import Path

import pytest
import yaml
from support.places import ROOT

from lgrasp.errors import ConfigError, HandError
from lgrasp.hand.find import find_hand
from lgrasp.hand.fingers import finger_roles
from lgrasp.hand.spec import load_spec
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import read_urdf
from lgrasp.steer.grasp_types import read_types, type_names
from lgrasp.steer.params import Steering
from lgrasp.steer.typed import made_types, typed

HANDS = ("allegro", "shadow", "leap", "barrett", "dclaw", "schunk_svh")


def parts(name):
    """Rules and joint tree of a hand."""
    source = find_hand(name)
    return source.spec, build_tree(read_urdf(source.urdf), source.spec)


@pytest.mark.parametrize("hand", HANDS)
def test_every_type_is_made_or_refused_by_what_is_missing(hand):
    spec, tree = parts(hand)
    made = made_types(spec, tree)
    contact = {link for rule in spec.contact for link in rule.links} | set(spec.palm.links)
    for name in type_names():
        if name in made.cannot:
            with pytest.raises(ConfigError, match=f"grasp type {name}: hand '{hand}' has no ") as error:
                typed(Steering(grasp_type=name), spec, tree)
            assert "\n" not in str(error.value)
        else:
            found = typed(Steering(grasp_type=name), spec, tree)
            assert len(found.fingers) + (found.palm == "must") >= 2
            assert set(found.fingers) <= set(spec.fingers)
            assert set(found.links) <= contact
            assert typed(found, spec, tree) == found
    assert sorted([*made.makes, *sum(made.makes.values(), ()), *made.cannot]) == sorted(type_names())


def test_types_with_the_same_contacts_are_told_together():
    for hand in HANDS:
        spec, tree = parts(hand)
        kinds = [
            typed(Steering(grasp_type=name), spec, tree).model_copy(update={"grasp_type": None})
            for name in made_types(spec, tree).makes
        ]
        assert len(set(kinds)) == len(kinds)


def test_the_taxonomy_is_whole():
    """All 33 types of the taxonomy are told: made by contacts, or left out with a reason."""
    told = read_types()
    assert len(type_names()) + len(told.left_out) == 33
    assert not set(type_names()) & set(told.left_out)
    with pytest.raises(ConfigError, match="grasp type 'lateral' cannot be steered: the thumb presses"):
        Steering(grasp_type="lateral")
    with pytest.raises(ConfigError, match="unknown grasp type 'tripot'; did you mean 'tripod'"):
        Steering(grasp_type="tripot")


def test_a_tripod_of_shadow():
    found = typed(Steering(grasp_type="tripod"), *parts("shadow"))
    assert found.fingers == ("thumb", "index", "middle")
    assert found.links == ("thdistal", "ffdistal", "mfdistal")
    assert found.palm == "no"
    assert typed(Steering(grasp_type="sphere-3-finger"), *parts("shadow")).links == ()


@pytest.mark.parametrize("asked", [{"fingers": "thumb,ring"}, {"links": "link_3.0_tip"}, {"palm": "must"}])
def test_what_touches_is_told_once(asked):
    with pytest.raises(ConfigError, match=f"grasp type tripod says what touches: leave out steer.{next(iter(asked))}"):
        typed(Steering(grasp_type="tripod", **asked), *parts("allegro"))


def test_roles_of_hand_yaml_and_of_names(tmp_path: Path):
    assert {role: finger for role, (finger, _) in finger_roles(*parts("barrett")).items()} == {
        "thumb": "three",
        "index": "one",
        "middle": "two",
    }
    folder = shutil.copytree(ROOT / "hands" / "allegro", tmp_path / "own")
    data = yaml.safe_load((folder / "hand.yaml").read_text())

    def write(**changes):
        (folder / "hand.yaml").write_text(yaml.safe_dump(data | changes))
        return folder / "hand.yaml"

    tree = parts("allegro")[1]
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
