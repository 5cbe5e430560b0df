"""Contact points that are left of an object, and how often each is drawn."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from lgrasp.errors import ConfigError
from lgrasp.object.model import SurfaceWeights
from lgrasp.object.preprocess import preprocess_object
from lgrasp.object.region_text import parse_regions
from lgrasp.object.steered import steer_object, surface_weights


@pytest.fixture(scope="module")
def ball(fast, tmp_path_factory):
    """A ball of 6 cm about (0.1, 0, 0), and its contact points in its own frame."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    mesh.apply_translation([0.1, 0, 0])
    path = tmp_path_factory.mktemp("ball") / "ball.stl"
    path.write_bytes(mesh.export(file_type="stl"))
    model = preprocess_object(path, params=fast)
    return SimpleNamespace(model=model, path=path, points=model.contact_points + model.center)


def often(ball, steered):
    """How many of the contact points are each of the whole object's."""
    place = {point.tobytes(): i for i, point in enumerate(ball.model.contact_points)}
    return np.bincount([place[p.tobytes()] for p in steered.model.contact_points], minlength=len(place))


def weighted(ball, touch=None, avoid=None, share=1.0):
    return SurfaceWeights(ball.points, touch, avoid, share)


def test_points_in_regions_are_left_once_each(ball):
    texts = ["box:0.1,-1,-1:1,1,1"], ["sphere:0.1,0,0.03:0.02", "sphere:0.1,0,-0.03:0.02"]
    touch, avoid = (parse_regions(text, "") for text in texts)
    steered = steer_object(ball.model, surface_weights(ball.model, touch, avoid, ball.path))
    tips = np.array([[0.1, 0, 0.03], [0.1, 0, -0.03]])
    near = (np.linalg.norm(ball.points[:, None] - tips, axis=2) <= 0.02).any(axis=1)
    np.testing.assert_array_equal(often(ball, steered), (ball.points[:, 0] >= 0.1) & ~near)
    normals = (ball.points - [0.1, 0, 0]) / 0.03
    kept = often(ball, steered) > 0
    assert np.einsum("nd,nd->n", steered.model.contact_normals, normals[kept]).min() > 0.99
    assert steered.touch.all()
    assert steered.off_centre == pytest.approx(np.linalg.norm(ball.points[kept].mean(axis=0) - [0.1, 0, 0]), abs=1e-4)


def test_opposite_points_are_in_the_region_too(ball):
    """A slab through the middle: every point has one on the other side, never one outside of the slab."""
    touch = parse_regions(["box:0,-1,-0.01:1,1,0.01"], "")
    left = steer_object(ball.model, surface_weights(ball.model, touch, (), ball.path)).model
    assert (left.contact_opposite >= 0).mean() > 0.9
    row = np.flatnonzero(left.contact_opposite >= 0)
    across = left.contact_points[left.contact_opposite[row]] - left.contact_points[row]
    assert np.abs(left.contact_points[:, 2]).max() <= 0.0101
    assert np.linalg.norm(across, axis=1).min() > 0.04


def test_draws_follow_the_weights(ball):
    weights = np.clip((ball.points[:, 0] - 0.07) / 0.06, 0, 1)
    count = often(ball, steer_object(ball.model, weighted(ball, touch=weights)))
    on = weights >= 0.5
    assert (count[~on] == 0).all()
    assert (count[on] > 0).all()
    np.testing.assert_allclose(count[on] / count.sum(), weights[on] / weights[on].sum(), rtol=0.1)
    count = often(ball, steer_object(ball.model, weighted(ball, avoid=weights)))
    assert (count[on] == 0).all()
    np.testing.assert_allclose(count[~on] / count.sum(), (1 - weights[~on]) / (1 - weights[~on]).sum(), rtol=0.1)


@pytest.mark.parametrize(("from_", "share", "drawn"), [(0.12, 0.7, 0.7), (0.08, 0.3, None)])
def test_share_of_the_draws(ball, from_, share, drawn):
    """At least the share is drawn in the region, everything else stays possible."""
    on = ball.points[:, 0] >= from_
    steered = steer_object(ball.model, weighted(ball, touch=on.astype(float), share=share))
    count = often(ball, steered)
    assert (count > 0).all()
    assert count[on].sum() / count.sum() == pytest.approx(drawn or on.mean(), abs=0.02)
    assert steered.touch.sum() == count[on].sum()
    assert steered.off_centre == 0.0


def test_the_share_is_drawn_however_many_points_there_are(ball, monkeypatch):
    monkeypatch.setattr("lgrasp.object.steered._DRAWS", 0)
    on = (ball.points[:, 0] >= 0.1).astype(float)
    steered = steer_object(ball.model, weighted(ball, touch=on, share=0.7))
    assert steered.touch.mean() == pytest.approx(0.7, abs=0.01)


def test_nothing_left_is_refused(ball):
    with pytest.raises(ConfigError, match="leaves none of the 50 surface points") as caught:
        steer_object(
            ball.model, weighted(ball, touch=np.arange(len(ball.points)) < 50, avoid=np.ones(len(ball.points)))
        )
    assert "\n" not in str(caught.value)
