"""The shipped Allegro hand: primitive geometry, and the kinematics of the real model."""

from pathlib import Path

import numpy as np
import pytest
import yaml
import yourdfpy

ROOT = Path(__file__).resolve().parents[2]
HAND = ROOT / "hands" / "allegro"
REAL = ROOT.parent / "shared" / "assets" / "hands" / "allegro" / "allegro.urdf"

needs_real = pytest.mark.skipif(
    not REAL.is_file(), reason="the real Allegro URDF is not at ../shared/assets/hands/allegro/allegro.urdf"
)


def load(path: Path) -> yourdfpy.URDF:
    return yourdfpy.URDF.load(str(path), load_meshes=False, build_collision_scene_graph=False)


@pytest.fixture(scope="module")
def ours() -> yourdfpy.URDF:
    return load(HAND / "hand.urdf")


@pytest.fixture(scope="module")
def rules() -> dict:
    return yaml.safe_load((HAND / "hand.yaml").read_text())


def test_geometry_is_primitive_and_visual_equals_collision(ours):
    empty = set()
    for name, link in ours.link_map.items():
        shapes = [(shape.geometry, shape.origin) for shape in link.collisions]
        if not shapes:
            empty.add(name)
        for geometry, _ in shapes:
            assert geometry.mesh is None
            assert any(x is not None for x in (geometry.box, geometry.cylinder, geometry.sphere))
        for (geometry, origin), visual in zip(shapes, link.visuals, strict=True):
            assert geometry == visual.geometry
            np.testing.assert_array_equal(origin, visual.origin)
    assert empty == {"palm", "wrist"}


def test_no_file_but_text_is_shipped():
    assert {p.name for p in HAND.iterdir()} == {"hand.urdf", "hand.yaml", "LICENSE", "README.md"}


def test_rules_name_what_exists(ours, rules):
    links = set(ours.link_map)
    named = [rules["base_link"], *rules["static_links"], *rules["palm"]["links"]]
    named += [link for rule in rules["contact"] for link in rule["links"]]
    named += [link for finger in rules["fingers"].values() for link in finger]
    assert set(named) <= links
    in_fingers = [link for finger in rules["fingers"].values() for link in finger]
    assert len(in_fingers) == len(set(in_fingers)) == 20
    assert (HAND / rules["urdf"]).is_file()
    low, high = (np.asarray(rules["canonical_box"][k]) for k in ("min", "max"))
    assert np.all(low < high)


def test_open_posture_is_inside_the_limits(ours, rules):
    assert set(rules["open_posture"]) == set(ours.actuated_joint_names)
    for name, value in rules["open_posture"].items():
        limit = ours.joint_map[name].limit
        assert limit.lower <= value <= limit.upper, name


@needs_real
def test_names_and_limits_equal_the_real_model(ours):
    real = load(REAL)
    assert set(ours.link_map) == set(real.link_map)
    assert list(ours.actuated_joint_names) == list(real.actuated_joint_names)
    assert set(ours.joint_map) == set(real.joint_map)
    for name, joint in real.joint_map.items():
        mine = ours.joint_map[name]
        assert (mine.type, mine.parent, mine.child) == (joint.type, joint.parent, joint.child)
        if joint.limit is not None:
            assert (mine.limit.lower, mine.limit.upper) == (joint.limit.lower, joint.limit.upper), name
            assert (mine.limit.effort, mine.limit.velocity) == (joint.limit.effort, joint.limit.velocity), name


@needs_real
def test_forward_kinematics_equals_the_real_model(ours):
    real = load(REAL)
    limits = [ours.joint_map[name].limit for name in ours.actuated_joint_names]
    low, high = np.array([x.lower for x in limits]), np.array([x.upper for x in limits])
    rng = np.random.default_rng(0)
    for q in rng.uniform(low, high, size=(50, len(limits))):
        ours.update_cfg(q)
        real.update_cfg(q)
        for link in ours.link_map:
            T_ours, T_real = ours.get_transform(link), real.get_transform(link)
            assert np.linalg.norm(T_ours[:3, 3] - T_real[:3, 3]) < 1e-4, link  # 0.1 mm
            # chord of the rotation between them: |R1 - R2|_F = 2 sqrt(2) sin(angle / 2)
            chord = np.linalg.norm(T_ours[:3, :3] - T_real[:3, :3]) / (2 * np.sqrt(2))
            assert 2 * np.arcsin(chord) < np.radians(0.01), link


def test_open_posture_is_free_of_self_collision(ours, rules):
    """No pair of links other than parent and child comes closer than 1 mm."""
    coal = pytest.importorskip("coal")

    def solid(geometry):
        if geometry.box is not None:
            return coal.Box(*geometry.box.size)
        if geometry.cylinder is not None:
            return coal.Cylinder(geometry.cylinder.radius, geometry.cylinder.length)
        return coal.Sphere(geometry.sphere.radius)

    ours.update_cfg(np.array([rules["open_posture"][name] for name in ours.actuated_joint_names]))
    solids = [
        (name, solid(shape.geometry), ours.get_transform(name) @ shape.origin)
        for name, link in ours.link_map.items()
        for shape in link.collisions
    ]
    adjacent = {frozenset((joint.parent, joint.child)) for joint in ours.joint_map.values()}
    for i, (a, solid_a, T_a) in enumerate(solids):
        for b, solid_b, T_b in solids[i + 1 :]:
            if a == b or frozenset((a, b)) in adjacent:
                continue
            distance = coal.distance(
                solid_a,
                coal.Transform3s(T_a[:3, :3], T_a[:3, 3]),
                solid_b,
                coal.Transform3s(T_b[:3, :3], T_b[:3, 3]),
                coal.DistanceRequest(),
                coal.DistanceResult(),
            )
            assert distance > 1e-3, (a, b)
