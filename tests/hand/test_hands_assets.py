"""The shipped hands: primitive geometry, and the kinematics of the real models."""

from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import yaml
import yourdfpy
from support.places import ASSETS, ROOT

from lgrasp.engine.cache import Cache
from lgrasp.hand.find import find_hand
from lgrasp.hand.spec import load_spec
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import read_urdf
from lgrasp.jobs.shard_inputs import named_hand

ASSETS = ASSETS / "hands"
# name -> movable joints, drives, dependency groups
HANDS = {
    "allegro": (16, 16, 4),
    "leap": (16, 16, 4),
    "shadow": (24, 22, 5),
    "dclaw": (9, 9, 3),
    "barrett": (8, 4, 3),
    "schunk_svh": (20, 9, 5),
}
REAL = {name: ASSETS / name / f"{name}.urdf" for name in HANDS} | {"barrett": ASSETS / "barrett" / "barrett_mimic.urdf"}

pytestmark = pytest.mark.parametrize("name", HANDS)


@cache
def ours(name: str) -> yourdfpy.URDF:
    return load(ROOT / "hands" / name / "hand.urdf")


@cache
def real(name: str) -> yourdfpy.URDF:
    if not REAL[name].is_file():
        pytest.skip(f"the real URDF is not at ../shared/assets/hands/{name}")
    return load(REAL[name])


def load(path: Path) -> yourdfpy.URDF:
    return yourdfpy.URDF.load(str(path), load_meshes=False, build_collision_scene_graph=False)


def rules(name: str) -> dict:
    return yaml.safe_load((ROOT / "hands" / name / "hand.yaml").read_text())


def test_geometry_is_primitive_and_visual_equals_collision(name):
    for link in ours(name).link_map.values():
        shapes = [(shape.geometry, shape.origin) for shape in link.collisions]
        for geometry, _ in shapes:
            assert geometry.mesh is None
            assert any(x is not None for x in (geometry.box, geometry.cylinder, geometry.sphere))
        for (geometry, origin), visual in zip(shapes, link.visuals, strict=True):
            assert geometry == visual.geometry
            np.testing.assert_array_equal(origin, visual.origin)


def test_no_file_but_text_and_a_policy_is_shipped(name):
    shipped = {p.name for p in (ROOT / "hands" / name).iterdir()}
    assert shipped - {"pose_policy.npz", "power_policy.npz"} == {"hand.urdf", "hand.yaml", "LICENSE", "README.md"}


def test_rules_name_what_exists(name):
    r, links = rules(name), set(ours(name).link_map)
    in_fingers = [link for finger in r["fingers"].values() for link in finger]
    named = [r["base_link"], *r["static_links"], *r["palm"]["links"], *in_fingers]
    named += [link for rule in r["contact"] for link in rule["links"]]
    assert set(named) <= links
    assert len(in_fingers) == len(set(in_fingers))
    assert r["name"] == name


def test_groups_and_sizes(name):
    movable, drives, groups = HANDS[name]
    folder = ROOT / "hands" / name
    urdf = read_urdf(folder / "hand.urdf")
    tree = build_tree(urdf, load_spec(folder / "hand.yaml"))
    assert sum(j.movable for j in urdf.joints) == movable
    assert len(tree.joint_names) == drives
    assert tree.groups == groups
    assert np.diff(tree.dof_first).max() <= 8
    assert np.diff(tree.joint_first).max() <= 16


def test_open_posture_is_inside_the_limits(name):
    r, joints = rules(name), ours(name).joint_map
    held = [(joint, value) for joint, value in r.get("locked", {}).items()]
    held += [(joint, value) for joint, values in r.get("shared", {}).items() for value in values]
    driven = {j for j in ours(name).actuated_joint_names if j not in dict(held)}
    assert set(r["open_posture"]) == driven
    for joint, value in [*held, *r["open_posture"].items()]:
        assert joints[joint].limit.lower <= value <= joints[joint].limit.upper, joint


def test_every_finger_and_palm_has_contact_points(name, cache_root):
    model, spec = named_hand(Cache(cache_root), name)[1], find_hand(name).spec
    tree = model.tree
    group = dict(zip(tree.link_names, tree.body_group[tree.link_body], strict=True))
    found = np.bincount(model.contact_link, minlength=len(tree.link_names))
    points = dict(zip(tree.link_names, found, strict=True))
    assert {group[link] for rule in spec.contact for link in rule.links} == set(range(tree.groups))
    for rule in (*spec.contact, spec.palm):
        for link in rule.links:
            assert points[link] > 100, link
    assert bool(spec.palm.links) == (name != "dclaw")
    for link in spec.palm.links:
        assert group[link] < 0


def test_names_limits_and_coupling_equal_the_real_model(name):
    a, b = ours(name), real(name)
    assert set(a.link_map) == set(b.link_map)
    assert set(a.actuated_joint_names) == set(b.actuated_joint_names)
    assert set(a.joint_map) == set(b.joint_map)
    for joint_name, joint in b.joint_map.items():
        mine = a.joint_map[joint_name]
        assert (mine.type, mine.parent, mine.child, mine.mimic) == (joint.type, joint.parent, joint.child, joint.mimic)
        if joint.limit is not None:
            assert (mine.limit.lower, mine.limit.upper) == (joint.limit.lower, joint.limit.upper), joint_name
            assert (mine.limit.effort, mine.limit.velocity) == (joint.limit.effort, joint.limit.velocity), joint_name


def test_forward_kinematics_equals_the_real_model(name):
    a, b = ours(name), real(name)
    limits = [b.joint_map[joint].limit for joint in b.actuated_joint_names]
    low, high = np.array([x.lower for x in limits]), np.array([x.upper for x in limits])
    rng = np.random.default_rng(0)
    for q in rng.uniform(low, high, size=(20, len(limits))):
        posture = dict(zip(b.actuated_joint_names, q, strict=True))
        a.update_cfg(posture)
        b.update_cfg(posture)
        for link in a.link_map:
            T_ours, T_real = a.get_transform(link), b.get_transform(link)
            assert np.linalg.norm(T_ours[:3, 3] - T_real[:3, 3]) < 1e-4, link  # 0.1 mm
            # chord of the rotation between them: |R1 - R2|_F = 2 sqrt(2) sin(angle / 2)
            chord = np.linalg.norm(T_ours[:3, :3] - T_real[:3, :3]) / (2 * np.sqrt(2))
            assert 2 * np.arcsin(chord) < np.radians(0.01), link


def test_the_real_urdf_finds_its_rules(name):
    real(name)  # skips when absent
    for path in {REAL[name], ASSETS / name / f"{name}.urdf"}:
        source = find_hand(str(path))
        assert (source.known, source.name, source.urdf) == (name, path.stem, path)
        tree = build_tree(read_urdf(path), source.spec)
        assert tree.groups == HANDS[name][2]


def test_open_posture_is_free_of_self_collision(name):
    """No pair of links other than parent and child comes closer than 0.5 mm."""
    coal = pytest.importorskip("coal")

    def solid(geometry):
        if geometry.box is not None:
            return coal.Box(*geometry.box.size)
        if geometry.cylinder is not None:
            return coal.Cylinder(geometry.cylinder.radius, geometry.cylinder.length)
        return coal.Sphere(geometry.sphere.radius)

    r, urdf = rules(name), ours(name)
    near = {frozenset((joint.parent, joint.child)) for joint in urdf.joint_map.values()}
    static = set(r["static_links"])
    settings = product(*([(joint, value) for value in values] for joint, values in r.get("shared", {}).items()))
    for setting in settings:
        posture = {**r.get("locked", {}), **r["open_posture"], **dict(setting)}
        urdf.update_cfg({k: v for k, v in posture.items() if k in urdf.actuated_joint_names})
        solids = [
            (link, solid(shape.geometry), urdf.get_transform(link) @ shape.origin)
            for link in urdf.link_map
            for shape in urdf.link_map[link].collisions
        ]
        for i, (a, solid_a, T_a) in enumerate(solids):
            for b, solid_b, T_b in solids[i + 1 :]:
                if a == b or frozenset((a, b)) in near or {a, b} <= static:
                    continue
                distance = coal.distance(
                    solid_a,
                    coal.Transform3s(T_a[:3, :3], T_a[:3, 3]),
                    solid_b,
                    coal.Transform3s(T_b[:3, :3], T_b[:3, 3]),
                    coal.DistanceRequest(),
                    coal.DistanceResult(),
                )
                assert distance > 5e-4, (a, b)
