"""The depth camera against geometry that is known exactly: a plane, a ball, what hides what, noise, offsets."""

import numpy as np
import pytest
import trimesh

from lgrasp.geometry.poses import pose_matrix
from lgrasp.picture.camera import Intrinsics, central_camera, look_at
from lgrasp.picture.depth import NOTHING, LabelledMesh, join_surfaces, render
from lgrasp.scenes.params import CameraParams
from lgrasp.scenes.render import (
    TABLE,
    add_noise,
    draw_offsets,
    image_normals,
    merge_views,
    place_cameras,
    table_surface,
)
from lgrasp.scenes.schema import DEPTH_UNIT

SIZE = 0.8
RADIUS = 0.08
CENTRE = np.array([0.05, -0.03, 0.2])


@pytest.fixture(scope="module")
def camera():
    return central_camera(160, 120, CameraParams().angle)


@pytest.fixture(scope="module")
def pose():
    return look_at(np.array([[0.6, 0.2, 0.5], [-0.3, 0.5, 0.6]]), np.array([0.0, 0.0, 0.05]))


@pytest.fixture(scope="module")
def surface():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    return join_surfaces(
        [table_surface(SIZE), LabelledMesh(ball.vertices + CENTRE, ball.faces, np.full(len(ball.faces), 7))]
    )


def expected(camera: Intrinsics, pose: np.ndarray):
    """Depths, labels and normals by closed formulas, and which rays miss every edge, shape (v, h, w, ...)."""
    T = pose_matrix(pose)
    way = camera.points(np.ones((len(pose), camera.height, camera.width)))
    way = np.einsum("vab,vhwb->vhwa", T[:, :3, :3], way)  # per metre of depth
    eye = np.broadcast_to(T[:, None, None, :3, 3], way.shape)
    plane = np.where(way[..., 2] < 0, -eye[..., 2] / way[..., 2], np.inf)
    at = eye + np.where(np.isfinite(plane), plane, 0)[..., None] * way
    margin = SIZE / 2 - np.abs(at[..., :2]).max(-1)
    plane = np.where(margin > 0, plane, np.inf)
    a, b = (way**2).sum(-1), ((eye - CENTRE) * way).sum(-1)
    inside = b**2 - a * (((eye - CENTRE) ** 2).sum(-1) - RADIUS**2)
    ball = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)
    depth = np.minimum(plane, ball)
    label = np.where(np.isinf(depth), NOTHING, np.where(ball < plane, 7, TABLE))
    hit = eye + np.where(np.isfinite(depth), depth, 0)[..., None] * way
    normal = np.where((label == 7)[..., None], (hit - CENTRE) / RADIUS, [0.0, 0.0, 1.0])
    sure = (np.abs(inside) > 2e-4) & (np.abs(margin) > 2e-3)
    return np.where(np.isinf(depth), 0, depth), label, normal, sure


def test_depths_and_labels_are_exact(camera, pose, surface, device):
    images = render(surface, camera, pose, device)
    depth, label, _, sure = expected(camera, pose)
    assert sure.mean() > 0.9
    np.testing.assert_array_equal(images.labels[sure], label[sure])
    assert {NOTHING, TABLE, 7} == set(np.unique(images.labels))  # the ball hides a part of the table
    np.testing.assert_allclose(images.depth[sure & (label == TABLE)], depth[sure & (label == TABLE)], atol=2e-6)
    np.testing.assert_allclose(images.depth[sure & (label == 7)], depth[sure & (label == 7)], atol=3e-4)
    assert (images.depth[images.labels == NOTHING] == 0).all()


def test_camera_looks_at_its_target_with_the_image_upright(camera):
    eye, target = np.array([[0.5, -0.4, 0.7]]), np.array([0.1, 0.1, 0.0])
    T = np.linalg.inv(pose_matrix(look_at(eye, target))[0])
    seen, above = (T @ [*p, 1.0] for p in (target, target + np.array([0, 0, 0.1])))
    np.testing.assert_allclose(seen[:3], np.array([0, 0, np.linalg.norm(eye - target)]), atol=1e-9)
    assert above[1] < -0.01  # y points down
    np.testing.assert_allclose(above[0], 0, atol=1e-9)


def test_cameras_stand_where_they_may():
    params = CameraParams(views=4, distance=(0.6, 0.7), elevation=(30, 50))
    pose = place_cameras(params, np.random.default_rng(3))
    away = np.linalg.norm(pose[:, :3], axis=1)
    assert ((away >= 0.6) & (away <= 0.7)).all()
    up = np.degrees(np.arcsin(pose[:, 2] / away))
    assert ((up >= 30) & (up <= 50)).all()
    turn = np.diff(np.unwrap(np.arctan2(pose[:, 1], pose[:, 0])))
    np.testing.assert_allclose(turn, np.pi / 2, atol=1e-9)


def test_normals_of_exact_depths(camera, pose, surface, device):
    images = render(surface, camera, pose, device)
    normals = image_normals(images, 2, device)
    _, label, true, sure = expected(camera, pose)
    found = np.abs(normals).sum(-1) > 0
    cosine = np.einsum("vhwc,vhwc->vhw", normals, true)
    inner = np.ones_like(sure)  # five pixels from every change of label
    for axis in (1, 2):
        for shift in range(-5, 6):
            inner &= np.roll(label, shift, axis) == label
    table = inner & (label == TABLE) & sure
    assert found[table].all()
    assert cosine[table].min() > 1 - 1e-4
    ball = inner & (label == 7) & sure
    assert ball.sum() > 200
    assert cosine[ball & found].min() > np.cos(np.radians(6))
    assert found[ball].mean() > 0.98


def test_noise_has_the_width_that_is_said(camera, pose, surface):
    params = CameraParams(width=160, height=120, noise=0.002, noise_square=0.004)
    images = render(surface, camera, pose)
    noisy = add_noise(images, params, np.random.default_rng(0))
    seen = images.depth > 0
    score = (noisy.depth - images.depth)[seen] / (0.002 + 0.004 * images.depth[seen] ** 2)
    assert abs(score.mean()) < 0.02
    assert abs(score.std() - 1) < 0.02
    assert (noisy.depth[~seen] == 0).all()


def test_what_lies_deeper_than_a_file_can_hold_is_not_seen(camera, surface):
    far = render(surface, camera, look_at(np.array([[0.1, 0.0, 6.6]]), np.zeros(3)))
    noisy = add_noise(far, CameraParams(noise=0.0, noise_square=0.0), np.random.default_rng(0))
    deep = far.depth > (2**16 - 1) * DEPTH_UNIT
    assert set(far.labels[deep]) == {TABLE}
    assert 7 in noisy.labels
    assert (noisy.depth[deep] == 0).all()
    assert (noisy.labels[deep] == NOTHING).all()
    np.testing.assert_allclose(noisy.depth[~deep], far.depth[~deep], atol=DEPTH_UNIT)


def test_offsets_are_of_one_length_in_any_direction():
    params = CameraParams(views=16, calibration=0.01)
    offsets = np.concatenate([draw_offsets(params, np.random.default_rng(k)) for k in range(100)])
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 0.01, rtol=1e-9)
    assert np.abs(offsets.mean(0)).max() < 6e-4
    np.testing.assert_allclose(offsets.var(0), 1e-4 / 3, rtol=0.15)


def test_merged_cloud_lies_on_the_surfaces_shifted_by_each_views_offset(camera, pose, surface):
    params = CameraParams(width=160, height=120, views=2, voxel=0.0, window=2)
    offsets = np.array([[0.01, 0.0, 0.0], [0.0, 0.0, -0.01]])
    cloud = merge_views(render(surface, camera, pose), offsets, params)
    assert set(cloud.view) == {0, 1}
    true = cloud.points - offsets[cloud.view]
    np.testing.assert_allclose(true[cloud.labels == TABLE, 2], 0, atol=2e-6)
    np.testing.assert_allclose(np.linalg.norm(true[cloud.labels == 7] - CENTRE, axis=1), RADIUS, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-4)
    eye = pose[cloud.view, :3] - true
    assert (np.einsum("nd,nd->n", eye, cloud.normals) > 0).all()


def test_one_point_of_a_cube(camera, pose, surface):
    params = CameraParams(width=160, height=120, views=2, window=2, voxel=0.02)
    cloud = merge_views(render(surface, camera, pose), np.zeros((2, 3)), params)
    cells = np.floor(cloud.points.astype(float) / 0.02).astype(int)
    assert len(np.unique(cells, axis=0)) > 0.98 * len(cells)  # rounding to float32 moves a few across a face


def test_what_nothing_hits_gives_an_empty_cloud(camera, surface):
    away = look_at(np.array([[0.0, 2.0, 1.0]]), np.array([0.0, 9.0, 2.0]))
    cloud = merge_views(render(surface, camera, away), np.zeros((1, 3)), CameraParams(width=160, height=120))
    assert len(cloud.points) == 0
