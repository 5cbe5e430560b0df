"""What the judge measures, against brute force and other libraries."""

from __future__ import annotations

import io

import numpy as np
import pytest
import trimesh
import yourdfpy
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from support.jawshard import JAW, URDF

from lgrasp.judge.collision import JudgedHand, PlacedSolids
from lgrasp.judge.duplicates import distinct_poses, near_duplicates
from lgrasp.judge.hand import origin
from lgrasp.judge.meshes import MeshDistance
from lgrasp.judge.shard import _resolver
from lgrasp.judge.solids import SAMPLES, BoxSolid, CylinderSolid, MeshSolid, SphereSolid, on_links
from lgrasp.judge.wrench import cone_forces, ferrari_canny, wrench_residual


def _closest_brute(p: np.ndarray, tri: np.ndarray) -> float:
    """Distance from a point to triangles (F, 3, 3), by plane and edges."""
    a, b, c = tri[:, 0], tri[:, 1], tri[:, 2]
    n = np.cross(b - a, c - a)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    height = ((p - a) * n).sum(axis=1)
    foot = p - height[:, None] * n
    inside = np.all([(np.cross(v - u, foot - u) * n).sum(axis=1) >= 0 for u, v in ((a, b), (b, c), (c, a))], axis=0)
    edges = []
    for u, v in ((a, b), (b, c), (c, a)):
        t = (((p - u) * (v - u)).sum(axis=1) / ((v - u) ** 2).sum(axis=1)).clip(0, 1)
        edges.append(np.linalg.norm(p - u - t[:, None] * (v - u), axis=1))
    return float(np.where(inside, np.abs(height), np.min(edges, axis=0)).min())


def test_mesh_distance_against_brute_force() -> None:
    mesh = trimesh.creation.annulus(0.02, 0.023, 0.05, sections=48)  # a wall of 3 mm
    field = MeshDistance(mesh)
    points = np.random.default_rng(0).uniform(-0.03, 0.03, (600, 3))
    signed = field.signed(points)
    brute = np.array([_closest_brute(p, mesh.triangles) for p in points])
    np.testing.assert_allclose(np.abs(signed), brute, atol=1e-7)
    clear = brute > 1e-6
    np.testing.assert_array_equal((signed < 0)[clear], mesh.contains(points)[clear])
    assert (signed < 0).sum() > 30
    np.testing.assert_allclose(field.depth(points), np.maximum(-signed, 0.0), atol=1e-12)


@pytest.mark.parametrize("kind", ["box", "sphere", "cylinder"])
def test_primitives_against_their_mesh(kind: str) -> None:
    T = origin(None)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", [0.3, -0.5, 1.0]).as_matrix(), [0.01, -0.02, 0.03]
    solid, mesh = {
        "box": (BoxSolid(0, T, np.array([0.01, 0.02, 0.03])), trimesh.creation.box((0.02, 0.04, 0.06))),
        "sphere": (SphereSolid(0, T, np.array([0.02])), trimesh.creation.icosphere(5, 0.02)),
        "cylinder": (CylinderSolid(0, T, np.array([0.015, 0.02])), trimesh.creation.cylinder(0.015, 0.04, 400)),
    }[kind]
    mesh.apply_transform(T)
    field = MeshDistance(mesh)
    points = np.random.default_rng(1).uniform(-0.05, 0.05, (400, 3)) + T[:3, 3]
    np.testing.assert_allclose(solid.signed(points), field.signed(points), atol=2e-5)
    h = 1e-6
    gradient = np.stack([solid.signed(points + h * e) - solid.signed(points - h * e) for e in np.eye(3)], axis=1) / (
        2 * h
    )
    smooth = np.abs(np.linalg.norm(gradient, axis=1) - 1.0) < 1e-6
    np.testing.assert_allclose(solid.normals(points)[smooth, 0], gradient[smooth], atol=1e-4)
    assert len(solid.samples) >= 0.95 * SAMPLES
    np.testing.assert_allclose(solid.signed(solid.samples), 0.0, atol=1e-12)


def test_a_face_that_another_solid_covers_has_no_say() -> None:
    """A rod whose end is inside a ball, 0.2 mm under its cap: the surface there is the ball's, or the rod's side."""
    up = origin(None)
    up[2, 3] = 0.02
    rod, ball = CylinderSolid(0, origin(None), np.array([0.007, 0.02])), SphereSolid(0, up, np.array([0.0075]))
    points = np.array([[0.0067, 0.0, 0.0198], [0.0067, 0.0, 0.0198], [0.0067, 0.0, 0.0]])
    ways = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 1.0, 0]])
    distance, normals = on_links([rod, ball], np.zeros(3, int), points, ways)
    assert (distance > -1e-3).all()
    angle = np.degrees(np.arccos(np.clip(np.einsum("npk,nk->np", normals, ways), -1, 1))).min(axis=1)
    assert angle[0] < 3  # the way out is through the ball
    assert (angle[1:] > 60).all()  # askew of the surfaces


def test_dented_meshes_are_not_hulls() -> None:
    tube = MeshSolid(0, np.eye(4), trimesh.creation.annulus(0.02, 0.023, 0.05, sections=48))
    ball = SphereSolid(1, np.eye(4), np.array([0.01]))  # inside the bore, touching nothing
    assert not tube.convex
    T = np.eye(4)[None, None].repeat(2, axis=1)
    assert PlacedSolids([tube, ball], T).depth(0, 0, 1, 0.0) < 0.0
    T = T.copy()
    T[0, 1, 0, 3] = 0.0115  # 1.5 mm into the wall
    assert PlacedSolids([tube, ball], T).depth(0, 0, 1, 0.0) == pytest.approx(1.5e-3, abs=1e-4)


def test_forward_kinematics_against_yourdfpy() -> None:
    blob = str(JAW.export(file_type="obj")).encode()
    hand = JudgedHand(URDF, _resolver({"package://jaws/meshes/jaw.obj": blob}, None), "left")
    other = yourdfpy.URDF.load(io.BytesIO(URDF.encode()), load_meshes=False)
    assert [j.name for j in hand.actuated] == list(other.actuated_joint_names)
    assert hand.always_touching == []
    values = {"slide_left": 0.01, "slide_right": 0.02, "swing": 0.7}
    other.update_cfg(values)
    T = hand.forward(hand.resolve_joints({k: np.array([v]) for k, v in values.items()}, 1), 1)[0]
    for i, name in enumerate(hand.links):
        np.testing.assert_allclose(T[i], other.get_transform(name, "left"), atol=1e-12)
    pairs = {tuple(sorted(hand.links[hand.solids[k].link] for k in pair)) for pair in hand.pairs}
    assert ("left", "right") in pairs
    assert not pairs & {("left", "palm"), ("thumb", "tip"), ("lever", "tip"), ("palm", "thumb")}


def test_wrench_residual_is_the_minimum() -> None:
    rng = np.random.default_rng(0)
    for count in (2, 3, 4, 5):
        points = rng.normal(size=(count, 3)) * 0.03
        inward = -points + rng.normal(size=(count, 3)) * 0.02
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        forces = cone_forces(inward)
        np.testing.assert_allclose(np.einsum("cek,ck->ce", forces, inward), 1.0)
        f = forces.reshape(-1, 3)
        G = np.vstack([f.T, 10.0 * np.cross(np.repeat(points - points.mean(axis=0), 8, axis=0), f).T])
        m = G.shape[1]
        best = minimize(
            lambda x, G=G: ((G @ x) ** 2).sum(),
            np.full(m, 1.0 / m),
            jac=lambda x, G=G: 2.0 * G.T @ (G @ x),
            bounds=[(0, 1)] * m,
            constraints={"type": "eq", "fun": lambda x: x.sum() - 1.0, "jac": np.ones_like},
            method="SLSQP",
            options={"ftol": 1e-16, "maxiter": 500},
        )
        norm, gap = wrench_residual(points, inward)
        assert norm**2 == pytest.approx(best.fun, abs=1e-8)
        assert abs(gap) < 1e-12


def test_ferrari_canny_of_a_symmetric_grasp() -> None:
    directions = np.vstack([np.eye(3), -np.eye(3)])
    full = ferrari_canny(directions * 0.02, -directions, np.zeros(3), 0.02)
    assert 0.1 < full < 0.5
    assert ferrari_canny(directions[:2] * 0.02, -directions[:2], np.zeros(3), 0.02) == 0.0


def test_near_duplicates_against_brute_force() -> None:
    rng = np.random.default_rng(0)
    n = 300
    centres = rng.integers(0, 60, n)
    t = rng.uniform(0, 0.05, (60, 3))[centres] + rng.normal(0, 0.0015, (n, 3))
    r = Rotation.random(60, rng=1)[centres] * Rotation.from_rotvec(rng.normal(0, 0.02, (n, 3)))
    q = rng.uniform(0, 1, (60, 7))[centres] + rng.normal(0, 0.03, (n, 7))
    quaternion = r.as_quat()[:, [3, 0, 1, 2]] * rng.choice([-1, 1], (n, 1))
    found = near_duplicates(np.hstack([t, quaternion])[:, None], q, np.full(7, 0.1))
    expected = np.zeros(n, bool)
    for i in range(1, n):
        a = np.linalg.norm(t[:i] - t[i], axis=1) / 0.005
        b = np.degrees((r[:i].inv() * r[i]).magnitude()) / 5.0
        c = np.abs(q[:i] - q[i]).max(axis=1) / 0.1
        expected[i] = (np.maximum(np.maximum(a, b), c) <= 1.0).any()
    np.testing.assert_array_equal(found, expected)
    assert 20 < found.sum() < n


def test_distinct_poses() -> None:
    poses = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 5e-7], [0.0, 1e-3], [np.nan, 0.0]])
    assert distinct_poses(poses) == 3
