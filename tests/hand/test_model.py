"""HandModel: groups, limits, solids, pairs and contact surfaces of real and shipped hands."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.interpolate import interpn
from support.convex import hull_distance
from support.hands import HANDS, hand_model, hand_source, minimal_spec
from support.urdfs import fingers

from lgrasp.errors import HandError
from lgrasp.geometry.union import joined_mesh, outer_mesh
from lgrasp.hand.build import build_hand
from lgrasp.hand.contacts import link_grid, link_points
from lgrasp.hand.geometry import convex_piece, geometry_mesh, inner_spheres, link_meshes, one_solid
from lgrasp.hand.model import HandModel
from lgrasp.hand.pairs import pieces_touch
from lgrasp.hand.piece import Piece
from lgrasp.hand.spec import Coupling
from lgrasp.hand.tree import Tree, build_tree
from lgrasp.hand.urdf import Geometry, Joint, read_urdf

GROUPS = {
    "shipped": [4, 4, 4, 4],
    "allegro": [4, 4, 4, 4],
    "leap": [4, 4, 4, 4],
    "shadow": [4, 4, 4, 5, 5],
    "dclaw": [3, 3, 3],
    "barrett": [3, 1],  # two fingers share the spread joint
    "schunk_svh": [1, 2, 2, 1, 1],  # thumb, index, middle, and ring and little with one drive each
}


def tree(name: str) -> Tree:
    path, spec = hand_source(name)
    return build_tree(read_urdf(path), spec)


def names(t: Tree) -> list[list[str]]:
    """Actuated joints of each group."""
    return [[t.joint_names[i] for i in t.dof_index[a:b]] for a, b in itertools.pairwise(t.dof_first)]


@pytest.mark.parametrize("name", HANDS)
def test_dependency_groups(name):
    t = tree(name)
    found = names(t)
    assert sorted(map(len, found)) == sorted(GROUPS[name])
    assert sorted(itertools.chain.from_iterable(found)) == sorted(t.joint_names)
    # no joint's parent is in another group, and parents come first
    for g in range(t.groups):
        parents = t.joint_parent[t.joint_first[g] : t.joint_first[g + 1]]
        assert (parents < np.arange(len(parents))).all()


def test_joints_are_named_in_file_order():
    joints = tree("shadow").joint_names
    path, _ = hand_source("shadow")
    text = path.read_text()
    place = [text.index(f'<joint name="{n}"') for n in joints]
    assert place == sorted(place)
    assert not {"WRJ1", "WRJ2"} & set(joints)


def test_barrett_fingers_share_the_spread():
    assert names(tree("barrett"))[0] == ["finger_1_prox_joint", "finger_1_med_joint", "finger_2_med_joint"]


def test_merged_fingers_beyond_the_kernels_are_refused_with_advice():
    path, _ = hand_source("schunk_svh")
    with pytest.raises(HandError, match="lock the joint that moves several fingers"):
        build_hand(path, minimal_spec("schunk_svh", ["right_hand_c"]))


@pytest.mark.parametrize("name", ["barrett", "schunk_svh"])
def test_limits_keep_every_mimic_joint_inside_its_own(name):
    path, spec = hand_source(name)
    t = tree(name)
    by_name = {j.name: j for j in read_urdf(path).joints}

    def coordinate(j: Joint, q: dict[str, float]) -> float:
        if j.name in spec.locked:
            return spec.locked[j.name]
        return q[j.name] if j.mimic is None else j.mimic[1] * coordinate(by_name[j.mimic[0]], q) + j.mimic[2]

    rng = np.random.default_rng(0)
    rows = [t.joint_lower, t.joint_upper, *rng.uniform(t.joint_lower, t.joint_upper, (50, len(t.joint_names)))]
    for row in rows:
        q = dict(zip(t.joint_names, map(float, row), strict=True))
        for j in by_name.values():
            if j.movable:
                assert j.lower - 1e-5 <= coordinate(j, q) <= j.upper + 1e-5, j.name
    # not narrower than needed: at each end some joint is at its limit
    for k, n in enumerate(t.joint_names):
        for end in (t.joint_lower[k], t.joint_upper[k]):
            q = dict.fromkeys(t.joint_names, 0.0) | {n: float(end)}
            slack = [
                min(abs(coordinate(j, q) - j.lower), abs(coordinate(j, q) - j.upper)) / max(1e-9, abs(mult))
                for j, mult in driven(by_name, n)
            ]
            assert min(slack) < 1e-5


def driven(by_name: dict[str, Joint], source: str) -> list[tuple[Joint, float]]:
    """Joints that a drive moves, itself included, with their multipliers."""
    out = []
    for j in by_name.values():
        mult, at = 1.0, j
        while at.mimic is not None:
            mult, at = mult * at.mimic[1], by_name[at.mimic[0]]
        if at.name == source and j.movable:
            out.append((j, mult))
    return out


def two_hinges(tmp_path: Path, follower: str, drive: str = '<limit lower="0" upper="1"/>') -> Path:
    """Joint j, and joint k that follows it; those without limits are continuous."""
    box = '<collision><geometry><box size="0.01 0.01 0.05"/></geometry></collision>'
    links = "".join(f'<link name="{n}">{box}</link>' for n in "abc")

    def kind(inner: str) -> str:
        return "revolute" if "<limit" in inner else "continuous"

    text = f"""<robot name="r">{links}
      <joint name="j" type="{kind(drive)}"><parent link="a"/><child link="b"/>{drive}</joint>
      <joint name="k" type="{kind(follower)}"><parent link="a"/><child link="c"/>{follower}</joint></robot>"""
    path = tmp_path / "r.urdf"
    path.write_text(text)
    return path


def test_mimic_joints_that_exclude_each_other(tmp_path):
    path = two_hinges(tmp_path, '<limit lower="-5" upper="-4"/><mimic joint="j"/>')
    with pytest.raises(HandError, match="'j' has no room left"):
        build_tree(read_urdf(path), minimal_spec("r", ["b"]))


def test_a_follower_that_is_held_outside_its_limits(tmp_path):
    path = two_hinges(tmp_path, '<limit lower="0" upper="1"/><mimic joint="j" multiplier="0" offset="2.5"/>')
    with pytest.raises(HandError, match=r"r.urdf: joint 'k' follows 'j' times 0.* 2.5, outside its limits \[0, 1\]"):
        build_tree(read_urdf(path), minimal_spec("r", ["b"]))


def test_a_drive_with_little_of_its_range_left_is_told(tmp_path, said):
    path = two_hinges(tmp_path, '<limit lower="-1" upper="0.05"/><mimic joint="j"/>')
    tree = build_tree(read_urdf(path), minimal_spec("r", ["b"]))
    assert (tree.joint_lower[0], tree.joint_upper[0]) == pytest.approx((0, 0.05))
    (line,) = said
    assert "'j' moves from 0 to 0.05 only, its limits are [0, 1]" in line


@pytest.mark.parametrize(
    ("drive", "follower", "limits"),
    [
        ('<limit lower="0" upper="1"/>', "", (0, 1)),
        ("", '<limit lower="-0.2" upper="1.5"/>', (-0.05, 0.375)),
        ("", "", (-np.pi, np.pi)),
    ],
)
@pytest.mark.parametrize("stated", [True, False])
def test_continuous_joints_narrow_nothing(tmp_path, said, drive, follower, limits, stated):
    spec, mimic = minimal_spec("r", ["b"]), '<mimic joint="j" multiplier="4"/>'
    if not stated:
        mimic, spec = "", spec.model_copy(update={"mimic": {"k": Coupling(joint="j", multiplier=4)}})
    tree = build_tree(read_urdf(two_hinges(tmp_path, follower + mimic, drive)), spec)
    assert (tree.joint_lower[0], tree.joint_upper[0]) == pytest.approx(limits)
    if not stated:  # a column of shards
        lower, upper = tree.coupled_limits[0]
        assert lower - 1e-6 <= 4 * limits[0] <= 4 * limits[1] <= upper + 1e-6
    assert not said


def surface_distance(mesh: trimesh.Trimesh, p: np.ndarray) -> np.ndarray:
    """Distances [m] of points to a surface, in millimetres: trimesh errs by 0.2 mm on triangles of 1e-3 units."""
    return trimesh.proximity.closest_point(mesh.copy().apply_scale(1e3), 1e3 * p.astype(float))[1] / 1e3


def pieces(model: HandModel) -> list[Piece]:
    v, p = model.vertex_first, model.plane_first
    return [
        Piece(model.vertices[v[i] : v[i + 1]].astype(float), model.planes[p[i] : p[i + 1]].astype(float), float(r))
        for i, r in enumerate(model.piece_radius)
    ]


def test_inner_spheres_are_inside_their_body():
    model = hand_model("shipped")
    solids = pieces(model)
    for body in range(len(model.piece_first) - 1):
        own = solids[model.piece_first[body] : model.piece_first[body + 1]]
        s = model.spheres[model.sphere_first[body] : model.sphere_first[body + 1]].astype(float)
        if own:
            assert len(s) > 0
            deepest = np.min([p.depth(s[:, :3]) for p in own], 0)
            assert (deepest + s[:, 3] < 2e-6).all()
            # and they reach deep: the thickest is nearly the body's own
            assert s[:, 3].max() > 0.001


def test_inner_spheres_of_one_piece_fill_it():
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * [0.01, 0.02, 0.03]
    planes = np.array([[*s * np.eye(3)[a], h] for a, h in enumerate((0.01, 0.02, 0.03)) for s in (-1, 1)])
    for piece in (
        Piece(corner, planes, 0.0),
        Piece(np.zeros((1, 3)), np.zeros((0, 4)), 0.01),
        Piece(np.array([[0, 0, 0], [0, 0, 0.05]]), np.zeros((0, 4)), 0.008),
    ):
        s = inner_spheres(piece, 28, np.random.default_rng(0))
        assert (piece.depth(s[:, :3]) + s[:, 3] < 1e-9).all()
        inside = np.random.default_rng(1).uniform(-0.06, 0.06, (200_000, 3))
        inside = inside[piece.depth(inside) < -0.003]
        gap = (np.linalg.norm(inside[:, None] - s[:, :3], axis=2) - s[:, 3]).min(1)
        assert gap.max() < 0.012


def test_cylinder_pieces_hold_the_cylinder():
    path, _ = hand_source("shipped")
    urdf = read_urdf(path)
    for radius, length in ((0.012, 0.05), (0.1, 0.01)):
        geometry = Geometry("cylinder", (radius, length), np.eye(4))
        piece = convex_piece(urdf, geometry, geometry_mesh(urdf, geometry))
        angle = np.linspace(0, 2 * np.pi, 999)
        rim = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(999, length / 2)])
        depth = piece.depth(np.vstack([rim, rim * [1, 1, -1]]))
        assert depth.max() < 1e-9
        # and little more than it
        assert np.linalg.norm(piece.vertices[:, :2], axis=1).max() < radius * 1.005


@pytest.mark.parametrize("name", ["leap", "shadow"])
def test_hull_pieces_are_within_a_fifth_of_a_millimetre(name):
    path, _ = hand_source(name)
    urdf = read_urdf(path)
    done = 0
    for solids in urdf.links.values():
        for geometry in solids:
            if geometry.kind != "mesh" or done >= 6:
                continue
            mesh = geometry_mesh(urdf, geometry)
            piece = convex_piece(urdf, geometry, mesh)
            hull = mesh.convex_hull
            # every hull vertex is within 0.2 mm of the piece: its plane excess picks those worth an exact distance
            excess = piece.depth(np.asarray(hull.vertices, float))
            worst = hull.vertices[np.argsort(-excess)[:5]]
            out = [hull_distance(v[None], piece.vertices) - piece.radius for v in worst]
            assert max(out) < 2.1e-4, geometry.mesh
            # the piece's own corners are on the true hull, so it exceeds it by no more than its radius
            assert piece.radius <= 2.0e-4
            assert surface_distance(hull, piece.vertices).max() < 1e-6
            done += 1
    assert done >= 4


@pytest.mark.parametrize("name", ["shipped", "leap"])
def test_pairs_leave_out_neighbours_and_what_always_touches(name):
    model = hand_model(name, pieces_only=True)
    path, _ = hand_source(name)
    urdf = read_urdf(path)
    links = model.tree.link_names
    kept = {frozenset((links[model.piece_link[i]], links[model.piece_link[j]])) for i, j in model.pairs}
    adjacent = {frozenset((j.parent, j.child)) for j in urdf.joints}
    assert not kept & adjacent
    body = dict(zip(links, model.tree.link_body, strict=True))
    solid = [n for n in links if (model.piece_link == links.index(n)).any()]
    candidates = {frozenset((a, b)) for a in solid for b in solid if a < b and body[a] != body[b]} - adjacent
    left_out = candidates - kept
    rng = np.random.default_rng(7)
    q = rng.uniform(model.tree.joint_lower, model.tree.joint_upper, (200, model.dofs))
    for pair in left_out:
        a, b = (np.flatnonzero(model.piece_link == links.index(n)) for n in pair)
        both = np.array([(i, j) for i in a for j in b], np.int32)
        assert pieces_touch(model, q, both).any(1).mean() > 0.98, sorted(pair)
    # what is kept comes apart in some posture
    touch = pieces_touch(model, q, model.pairs)
    for pair in kept:
        member = [frozenset((links[model.piece_link[i]], links[model.piece_link[j]])) == pair for i, j in model.pairs]
        assert not touch[:, np.array(member)].any(1).all(), sorted(pair)


def test_pairs_are_sorted_into_their_groups():
    model = hand_model("shadow", pieces_only=True)
    group = model.tree.body_group + 1
    G = model.groups + 1
    assert len(model.pair_first) == G * G + 1
    assert model.pair_first[-1] == len(model.pairs)
    for key in range(G * G):
        for i, j in model.pairs[model.pair_first[key] : model.pair_first[key + 1]]:
            assert (group[model.piece_body[i]], group[model.piece_body[j]]) == (key // G, key % G)
            assert key // G <= key % G


def test_contact_points_obey_the_rules():
    model = hand_model("shipped")
    path, spec = hand_source("shipped")
    tree = model.tree
    assert (np.diff(model.contact_first) > 50).all()
    np.testing.assert_allclose(np.linalg.norm(model.contact_normals, axis=1), 1, atol=1e-5)
    forbidden = {link: rule.forbidden for rule in spec.contact for link in rule.links}
    for index in np.unique(model.contact_link):
        link, own = tree.link_names[index], model.contact_link == index
        n = model.contact_normals[own] @ tree.T_body_link[index][:3, :3]
        for cone in forbidden.get(link, ()):
            assert (n @ np.array(cone.axis) <= np.cos(np.radians(cone.angle)) + 1e-6).all()
        if link in spec.palm.links:
            allowed = [n @ np.array(c.axis) >= np.cos(np.radians(c.angle)) - 1e-6 for c in spec.palm.allowed]
            assert np.any(allowed, 0).all()
        # on the surface of the link's solid
        solid = joined_mesh(link_meshes(read_urdf(path), tree, link))
        assert surface_distance(solid, model.contact_points[own][:60]).max() < 1e-6
    # one patch: near in place and direction
    for patch in np.unique(model.contact_patch)[::7]:
        own = model.contact_patch == patch
        assert np.ptp(model.contact_points[own], axis=0).max() < 0.0201
        assert len(np.unique(model.contact_link[own])) == 1


def test_arrays_round_trip_and_two_builds_are_equal(tmp_path):
    source = fingers(tmp_path, 2), minimal_spec("fingers", ["b0", "b1"])
    model, again = build_hand(*source), build_hand(*source)
    back = HandModel.from_arrays(model.to_arrays())
    for other in (back, again):
        for key, value in model.to_arrays().items():
            np.testing.assert_array_equal(value, other.to_arrays()[key], err_msg=key)
    assert back.tree.link_names == model.tree.link_names
    assert isinstance(back.tree.joint_names, tuple)
    assert back.notes == model.notes


def test_recessed_surface_is_no_contact():
    """Between two ribs an object meets the ribs first; their tops and the plate's underside may touch."""
    plate = trimesh.creation.box((0.04, 0.04, 0.005))
    ribs = [trimesh.creation.box((0.005, 0.04, 0.005)).apply_translation((x, 0, 0.005)) for x in (-0.0075, 0.0075)]
    points, normals = link_points([plate, *ribs], np.eye(4), (), np.random.default_rng(0))
    up = normals[:, 2] > 0.99
    assert (points[up, 2] > 0.0074).mean() > 0.5
    assert not (up & (np.abs(points[:, 0]) < 0.005)).any()
    assert (normals[:, 2] < -0.99).sum() > 50


def test_walls_of_one_body_inside_another_are_no_outside():
    """A mesh file of two boxes through each other: depth is that to the outside, and no wall within is a contact."""
    boxes = [trimesh.creation.box((0.02, 0.02, 0.02)).apply_translation((x, 0, 0)) for x in (0.0, 0.009)]
    apart = joined_mesh([boxes[0], boxes[1].copy().apply_translation((0.05, 0, 0))])
    assert one_solid(apart) is apart
    small = [trimesh.creation.box([side] * 3).apply_translation((x, 0, 0)) for side, x in ((0.1, 0.2), (0.005, 0.01))]
    assert one_solid(joined_mesh([boxes[0], *small])).body_count == 2  # sunk by half its side, beside a large one
    whole = one_solid(joined_mesh(boxes))
    assert whole.volume == pytest.approx(0.029 * 0.02**2)
    grid = link_grid([whole])
    middle = np.array([[0.0045, 0, 0], [-0.001, 0, 0.003], [0.0105, 0, 0]])  # [m], near walls at x = -1 and 10 mm
    places = [grid.origin[a] + grid.cell * np.arange(grid.values.shape[a]) for a in range(3)]
    np.testing.assert_allclose(interpn(places, grid.values, middle), [-0.01, -0.007, -0.0085], atol=2e-4)
    points, _ = link_points([whole], np.eye(4), (), np.random.default_rng(0))
    assert (np.abs(points[np.abs(points[:, 0] - 0.0045) < 0.0135]).max(1) > 0.0099).all()


def test_what_one_solid_covers_of_another_is_no_surface():
    balls = [trimesh.creation.icosphere(4, 0.01).apply_translation([x, 0, 0]) for x in (0.0, 0.01)]
    whole = outer_mesh(balls)
    assert whole.is_volume
    for x in (0.0, 0.01):  # icospheres lie inside of their spheres by up to 0.1 mm
        assert np.linalg.norm(whole.triangles_center - [x, 0, 0], axis=1).min() > 0.0098
    cap = np.pi * 0.005**2 * (3 * 0.01 - 0.005) / 3
    assert whole.volume == pytest.approx(2 * (4 / 3 * np.pi * 0.01**3 - cap), rel=0.01)
    open_ball = trimesh.Trimesh(balls[0].vertices, balls[0].faces[1:], process=False)
    assert len(outer_mesh([balls[1], open_ball]).faces) == len(balls[1].faces) + len(open_ball.faces)
