"""Point clouds as objects."""

import numpy as np
import pytest
import trimesh

from lgrasp.cloud.model import TRUST, cloud_object, searched_object
from lgrasp.errors import ObjectError
from lgrasp.object.params import ObjectParams
from lgrasp.object.sdf import sample_sdf

RADIUS = 0.05


def sphere(count: int = 3000) -> np.ndarray:
    """Unit vectors, evenly spread."""
    return trimesh.creation.icosphere(subdivisions=4).vertices[:count]


def distance(model, points: np.ndarray) -> np.ndarray:
    return sample_sdf(model.grid, points - model.center)


def test_distances_of_a_sphere_are_the_same_each_time():
    n = sphere()
    model = cloud_object(RADIUS * n + 0.3, n)
    again = cloud_object(RADIUS * n + 0.3, n)
    assert again.sha256 == model.sha256
    np.testing.assert_array_equal(again.sdf, model.sdf)
    rng = np.random.default_rng(0)
    way = rng.normal(size=(500, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    d = rng.uniform(-0.8 * TRUST, 0.012, 500)
    np.testing.assert_allclose(distance(model, (RADIUS + d)[:, None] * way + 0.3), d, atol=1.2e-3)


def test_what_is_behind_a_seen_side_is_no_obstacle():
    n = sphere()
    n = n[n[:, 2] > 0]
    model = cloud_object(RADIUS * n, n)
    deep = np.array([[0, 0, 0.01], [0, 0.01, 0.005]])
    assert (distance(model, deep) > 0).all()
    assert distance(model, np.array([[0, 0, 0.04]]))[0] == pytest.approx(-0.01, abs=2e-3)


def test_noise_averages_out():
    n, noise = sphere(), 0.005
    points = RADIUS * n + np.random.default_rng(0).normal(size=n.shape) * noise
    model = cloud_object(points, n)
    off = np.linalg.norm(model.contact_points + model.center, axis=1) - RADIUS
    assert np.median(np.abs(off)) < 0.35 * noise
    assert (model.contact_normals * (model.contact_points + model.center)).sum(1).min() > 0


def test_pipelines_search_whole_clouds_about_their_middle():
    """A ball of which the internal frame was elsewhere: the same places, contacts all around, with their opposites."""
    n = sphere()
    points = RADIUS * n + 0.02
    seen = cloud_object(points, n, centred=False)
    model = searched_object(seen, ObjectParams())
    np.testing.assert_allclose(model.center, 0.02, atol=2e-3)
    np.testing.assert_allclose(distance(model, points[::50]), distance(seen, points[::50]), atol=1e-6)
    contacts = model.contact_points
    np.testing.assert_allclose(np.linalg.norm(contacts, axis=1), RADIUS, atol=2e-3)
    assert (np.abs(contacts.mean(0)) < 0.1 * RADIUS).all()
    there = model.contact_opposite >= 0
    assert there.mean() > 0.95
    facing = (model.contact_normals[there] * model.contact_normals[model.contact_opposite[there]]).sum(1)
    assert facing.max() < -0.4
    assert np.linalg.norm(model.cluster_center, axis=1).max() < 1.1 * RADIUS


def test_a_side_alone_cannot_be_pressed_on():
    n = sphere()
    n = n[n[:, 2] > 0.6]
    with pytest.raises(ObjectError, match=r"cloud 'dish' shows no two sides to press on"):
        searched_object(cloud_object(RADIUS * n, n, name="dish"), ObjectParams())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p, n: (p[:10], n[:10]), "at least 32"),
        (lambda p, n: (p * 1000, n), "units metres"),
        (lambda p, n: (np.where(np.arange(len(p))[:, None] == 3, np.nan, p), n), "NaN"),
        (lambda p, n: (p, n * 0), "normals"),
        (lambda p, n: (p, n[:-1]), "normals"),
        (lambda p, n: (p[:, :2], n), "shape"),
    ],
)
def test_bad_clouds(change, said):
    n = sphere(1000)
    with pytest.raises(ObjectError, match=said):
        cloud_object(*change(RADIUS * n, n))
