"""Opposition spaces: bookkeeping against a brute force, Allegro's seven, and what a view of a hand holds."""

from functools import cache
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lxml import etree
from scipy.ndimage import map_coordinates
from support.hands import hand_model, hand_source
from support.places import ROOT

from lgrasp.errors import HandError
from lgrasp.hand.build import build_hand
from lgrasp.hand.digest import hand_digest
from lgrasp.hand.find import find_hand
from lgrasp.hand.model import HandModel
from lgrasp.hand.opposition.spaces import Space, available, hand_spaces, longest, spaces_view
from lgrasp.hand.spec import HandSpec

# index 0-3, middle 4-7, ring 8-11, thumb 12-15
ALLEGRO = {
    "index-palm": range(4),
    "middle-palm": range(4, 8),
    "ring-palm": range(8, 12),
    "thumb-palm": range(12, 16),
    "index-middle": range(8),
    "middle-ring": range(4, 12),
    "thumb-index": [*range(4), *range(12, 16)],
}


@cache
def allegro_spaces() -> tuple[Space, ...]:
    return hand_spaces(hand_source("shipped")[1], hand_model("shipped").tree)


@cache
def view(*names: str) -> HandModel:
    return spaces_view(*hand_source("shipped"), hand_model("shipped"), names)


def space(joints: list[bool], name: str = "s") -> Space:
    return Space(name, np.array(joints), (0, -1))


# bookkeeping


def brute_longest(spaces: list[Space], used: set[int], joints: np.ndarray) -> int:
    """Longest prefix over all orders of the spaces that can be taken step by step."""
    best = 0
    for order in permutations(i for i in range(len(spaces)) if i not in used):
        taken = joints.copy()
        for step, i in enumerate(order):
            free = spaces[i].joints & ~taken
            if not free.any():
                break
            taken |= free
            best = max(best, step + 1)
    return best


@settings(deadline=None)
@given(st.data())
def test_longest_is_that_of_a_brute_force(data):
    joints = data.draw(st.integers(1, 6))
    mask = st.lists(st.booleans(), min_size=joints, max_size=joints)
    spaces = [space(m) for m in data.draw(st.lists(mask, max_size=5))]
    used = set(data.draw(st.lists(st.sampled_from(range(len(spaces))), unique=True))) if spaces else set()
    taken = np.array(data.draw(mask))
    found = longest(spaces, used, taken)
    assert found == brute_longest(spaces, used, taken)
    assert (not available(spaces, used, taken)) == (found == 0)
    if found:  # some space that may come next leads there
        following = available(spaces, used, taken)
        assert found == 1 + max(longest(spaces, used | {i}, taken | spaces[i].joints) for i in following)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(0, 6), max_size=8))
def test_a_sequence_on_allegro_never_moves_a_joint_twice(picks):
    spaces, used, joints = allegro_spaces(), [], np.zeros(16, bool)
    steps = 0
    for pick in picks:
        following = available(spaces, used, joints)
        assert set(following).isdisjoint(used)
        if not following:
            break
        i = following[pick % len(following)]
        free = spaces[i].joints & ~joints
        assert free.any()
        assert not (free & joints).any()
        assert not (free & ~spaces[i].joints).any()
        before = longest(spaces, used, joints)
        used, joints, steps = [*used, i], joints | free, steps + 1
        assert longest(spaces, used, joints) <= before - 1
    assert steps <= 4


def test_allegro_sequences():
    """Worked by hand: four fingers give four steps at most; thumb with index drops both of their palm spaces."""
    spaces, none = allegro_spaces(), np.zeros(16, bool)
    names = [s.name for s in spaces]
    assert longest(spaces, [], none) == 4
    i = names.index("thumb-index")
    after = spaces[i].joints
    assert np.flatnonzero(after).tolist() == [0, 1, 2, 3, 12, 13, 14, 15]
    left = [names[k] for k in available(spaces, [i], after)]
    assert left == ["middle-palm", "ring-palm", "index-middle", "middle-ring"]
    assert longest(spaces, [i], after) == 2
    # index-middle then has the middle finger's joints only
    j = names.index("index-middle")
    assert np.flatnonzero(spaces[j].joints & ~after).tolist() == [4, 5, 6, 7]
    assert not available(spaces, [], np.ones(16, bool))
    assert available(spaces, [], none)


def test_a_used_space_does_not_come_back_though_its_joints_are_free():
    spaces = [space([True, True]), space([True, False])]
    assert available(spaces, [0], np.array([False, True])) == [1]
    assert longest(spaces, [0], np.array([False, False])) == 1


# Allegro's seven


def test_allegro_has_the_seven_spaces():
    path, _ = hand_source("shipped")
    source = find_hand(str(path))
    tree = hand_model("shipped").tree
    spaces = hand_spaces(source.spec, tree)
    assert [s.name for s in spaces] == list(ALLEGRO)
    finger = {n: int(tree.body_group[tree.link_body[tree.link_names.index(n)]]) for n in tree.link_names}
    group = {name: finger[links[-1]] for name, links in source.spec.fingers.items()} | {"palm": -1}
    for s in spaces:
        expected = np.zeros(16, bool)
        expected[list(ALLEGRO[s.name])] = True
        np.testing.assert_array_equal(s.joints, expected)
        assert {tree.joint_names[k] for k in np.flatnonzero(s.joints)} == {f"joint_{k}.0" for k in ALLEGRO[s.name]}
        assert set(s.groups) == {group[part] for part in s.name.split("-")}


@pytest.mark.parametrize("name", ["thumb-palm", "index-middle"])
def test_view_holds_the_surface_of_the_sides_and_no_other(name):
    whole, model = hand_model("shipped"), view(name)
    tree, links = whole.tree, whole.tree.link_names
    s = next(s for s in allegro_spaces() if s.name == name)
    count = np.diff(model.contact_first)
    surfaces = {g if g >= 0 else whole.groups for g in s.groups}
    assert {int(g) for g in np.flatnonzero(count)} == surfaces
    assert count[count > 0].min() > 200
    assert model.contacts == ()
    assert model.sha256 != whole.sha256
    side = {link: part for sides in hand_source("shipped")[1].opposition_spaces[name].sides for part in sides
            for link in part.links}  # fmt: skip
    assert {links[i] for i in np.unique(model.contact_link)} == set(side)
    assert set(model.grid_link) == set(model.contact_link) | set(whole.grid_link)
    for index in np.unique(model.contact_link):
        own, part = model.contact_link == index, side[links[index]]
        R, t = tree.T_body_link[index][:3, :3], tree.T_body_link[index][:3, 3]
        n, p = model.contact_normals[own] @ R, (model.contact_points[own] - t) @ R
        assert (n @ np.array(part.axis) > np.cos(np.radians(part.angle)) - 1e-6).all()
        if part.box is not None:
            assert (p >= np.array(part.box.min) - 1e-6).all()
            assert (p <= np.array(part.box.max) + 1e-6).all()
        # the same as a rule: no point is in a forbidden cone of its link
        grid = int(np.flatnonzero(model.grid_link == index)[0])
        for rule in model.rules[model.rule_first[grid] : model.rule_first[grid + 1]]:
            assert (model.contact_normals[own] @ rule[:3] <= rule[3] + 1e-6).all()
    # everything else is the hand's own
    for key in ("pairs", "vertices", "spheres", "samples", "overlap_points", "canonical_box"):
        np.testing.assert_array_equal(getattr(model, key), getattr(whole, key))
    assert model.tree is whole.tree


def test_view_of_several_spaces_has_the_surfaces_of_each_one_after_another():
    names = ("thumb-index", "index-palm")
    both, parts = view(*names), [view(name) for name in names]
    assert both.surfaces == 2
    for key in ("contact_points", "contact_normals", "contact_link", "contact_group"):
        np.testing.assert_array_equal(getattr(both, key), np.concatenate([getattr(part, key) for part in parts]))
    np.testing.assert_array_equal(
        np.diff(both.contact_first), [*np.diff(parts[0].contact_first), *np.diff(parts[1].contact_first)]
    )
    np.testing.assert_array_equal(both.grid_link[both.contact_grid], both.contact_link)
    assert set(both.grid_link) == set(parts[0].grid_link) | set(parts[1].grid_link)
    rules = [[m.rules[m.rule_first[g] : m.rule_first[g + 1]] for g in m.contact_grid] for m in (both, *parts)]
    for one, other in zip(rules[0], rules[1] + rules[2], strict=True):
        np.testing.assert_array_equal(one, other)


def test_grids_of_a_view_are_those_of_its_links():
    """Those that the hand has, and those that it has not, by the same rule: zero at the link's own contact points."""
    model = view("index-middle")
    for i in np.unique(model.contact_grid):
        own = model.contact_grid == i
        grid = model.grid_values[model.grid_first[i] : model.grid_first[i + 1]].reshape(model.grid_shape[i])
        place = (model.contact_points[own] - model.grid_origin[i]) / model.grid_cell[i]
        assert abs(map_coordinates(grid, place.T, order=1)).max() < 4e-4
        out = place + 3e-3 * model.contact_normals[own] / model.grid_cell[i]
        assert abs(map_coordinates(grid, out.T, order=1) - 3e-3).max() < 1e-3


def test_thirds_of_the_palm_lie_under_their_fingers():
    """y is lateral, and index, middle and ring are mounted at falling y."""
    tree = hand_model("shipped").tree
    root = [tree.T_parent_joint[tree.joint_first[g]][1, 3] for g in range(3)]
    assert root[0] > root[1] > root[2]
    for g, name in enumerate(("index-palm", "middle-palm", "ring-palm")):
        model = view(name)
        y = model.contact_points[model.contact_first[4] :, 1]
        assert np.argmin([abs(r - y.mean()) for r in root]) == g
        assert np.ptp(y) > 0.03


@pytest.mark.parametrize("name", sorted(p.name for p in (ROOT / "hands").iterdir()))
def test_pads_are_no_surface_that_the_contact_rules_forbid(name):
    """A wrong sign in either is seen here: a pad would look where no contact may be."""
    spec = find_hand(name).spec
    forbidden = {link: rule.forbidden for rule in spec.contact for link in rule.links}
    sides = [part for space in spec.opposition_spaces.values() for side in space.sides for part in side]
    pads = [(link, part.axis) for part in sides if part.angle == 60 for link in part.links if link in forbidden]
    assert {link for link, _ in pads} & set(forbidden)
    for link, axis in pads:
        for cone in forbidden[link]:
            cosine = np.dot(axis, cone.axis) / np.linalg.norm(axis) / np.linalg.norm(cone.axis)
            turned = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))  # rounding may pass 1
            # a fingertip may be used beyond its side only: then the pad is just at the edge of what is allowed
            assert turned > cone.angle - 2, link


# refusals

PAD = {"links": ["link_3.0_tip"], "axis": [1, 0, 0], "angle": 60}
PALM = {"links": ["base_link"], "axis": [1, 0, 0], "angle": 45}
BAD = {
    "joint": ({"joints": ["joint_99.0"]}, "'joint_99.0' is no driven joint; driven joints: joint_0.0"),
    "joint elsewhere": ({"joints": ["joint_0.0", "joint_4.0"]}, "'joint_4.0' moves neither side; joints that do"),
    "link": ({"sides": [PALM, PAD | {"links": ["nowhere"]}]}, "'nowhere' does not exist; links: base_link"),
    "no solid": ({"sides": [PALM | {"links": ["wrist"]}, PAD]}, "'wrist' has no collision geometry"),
    "twice": ({"sides": [PALM, [PAD, PAD]]}, "'link_3.0_tip' is in it twice"),
    "two fingers": ({"sides": [PALM, PAD | {"links": ["link_3.0", "link_7.0"]}]}, "'link_3.0' and 'link_7.0' of"),
    "one finger": ({"sides": [PAD, PAD | {"links": ["link_2.0"]}]}, "both sides ride on one finger"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_space_that_does_not_fit_the_hand(name):
    change, expected = BAD[name]
    urdf, spec = hand_source("shipped")
    data = {"joints": ["joint_0.0"], "sides": [PALM, PAD]} | change
    spec = HandSpec.model_validate(spec.model_dump() | {"opposition_spaces": {"mine": data}})
    with pytest.raises(HandError, match="hand 'allegro': opposition space 'mine': .*" + expected):
        build_hand(urdf, spec)


def test_locked_joints_and_unknown_spaces():
    urdf, spec = hand_source("shipped")
    locked = spec.model_copy(update={"locked": {"joint_1.0": 0.0}})
    with pytest.raises(HandError, match=r"joint 'joint_1\.0' is locked; driven joints: joint_0\.0, joint_2\.0"):
        build_hand(urdf, locked)
    with pytest.raises(HandError, match="no opposition space 'thumb'; its spaces: index-palm, middle-palm"):
        spaces_view(urdf, spec, hand_model("shipped"), ["thumb"])
    away = PAD | {"axis": [0, 0, -1], "angle": 10}
    empty = HandSpec.model_validate(
        spec.model_dump() | {"opposition_spaces": {"mine": {"joints": ["joint_0.0"], "sides": [PALM, away]}}}
    )
    with pytest.raises(HandError, match=r"'mine': side 2 \(link_3.0_tip\) has no surface within 10 degrees"):
        spaces_view(urdf, empty, hand_model("shipped"), ["mine"])


def test_a_variant_of_a_known_hand_keeps_the_spaces_that_fit(tmp_path):
    """A URDF with the known names takes the known rules; a link that has lost its solid takes its spaces with it."""
    urdf = etree.parse(str(hand_source("shipped")[0]))
    for collision in urdf.xpath("//link[@name='link_5.0']/collision"):
        collision.getparent().remove(collision)
    path = tmp_path / "variant.urdf"
    urdf.write(str(path))
    source = find_hand(str(path))
    assert list(source.spec.opposition_spaces) == [n for n in ALLEGRO if n not in ("index-middle", "middle-ring")]
    assert "without the opposition spaces index-middle, middle-ring, which do not fit: link 'link_5.0'" in source.note


def test_a_hand_without_spaces_is_legal():
    urdf, spec = hand_source("shipped")
    bare = spec.model_copy(update={"opposition_spaces": {}})
    assert hand_spaces(bare, hand_model("shipped").tree) == ()
    assert longest((), [], np.zeros(16, bool)) == 0
    # and the hand itself is the same: its digest does not follow the spaces
    assert hand_digest(urdf, bare) == hand_digest(urdf, spec)
