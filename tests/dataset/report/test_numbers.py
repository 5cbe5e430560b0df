"""Numbers of the report against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lgrasp.dataset.report.diversity import Coverage, principal_postures
from lgrasp.dataset.report.gather import EvenSample
from lgrasp.dataset.report.quantity import QUANTITIES, Distribution
from lgrasp.geometry.poses import pose_matrix
from lgrasp.judge import bounds as judge_bounds


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 40), max_size=12), st.integers(1, 20))
def test_sample_of_any_cut(sizes, limit):
    rows, sample = np.arange(sum(sizes)), EvenSample(limit)
    for part in np.split(rows, np.cumsum(sizes)[:-1]) if sizes else []:
        sample.add({"row": part})
    held = sample.columns().get("row", rows[:0])
    assert len(held) <= limit
    np.testing.assert_array_equal(held, rows[:: sample.step])
    assert sample.step == 1 or 2 * len(held) >= limit


def test_bounds_are_those_of_the_judge():
    shown = {q.name: q.bound / q.factor for q in QUANTITIES if q.bound is not None}
    names = {"penetration": "PENETRATION", "self_penetration": "SELF_PENETRATION", "gap": "CONTACT_DISTANCE"}
    judged = {name: getattr(judge_bounds, constant) for name, constant in names.items()}
    judged |= {"normal_error": math.radians(judge_bounds.NORMAL_DEG), "gswo": judge_bounds.RESIDUAL}
    assert shown == pytest.approx(judged)


def test_quantiles():
    random = np.random.default_rng(0)
    values = random.gamma(2.0, 2e-4, 5000)
    distribution = Distribution(QUANTITIES[0])
    for part in np.array_split(values, 7):
        distribution.add(part)
    for share in (0.05, 0.5, 0.95):
        assert distribution.quantile(share) == pytest.approx(1e3 * np.quantile(values, share), rel=0.02)
    for few in ([0.02e-3, 0.1e-3], 95 * [0.01e-3] + 5 * [0.3e-3]):
        of_few = Distribution(QUANTITIES[0])
        of_few.add(np.array(few))
        for share in (0.5, 0.95):
            assert of_few.quantile(share) == pytest.approx(1e3 * np.quantile(few, share), rel=0.05)
    edges, counts = distribution.bars()
    np.testing.assert_allclose(counts.sum(), 5000)
    shown = np.histogram(1e3 * values, edges)[0]
    assert np.abs(counts - shown).sum() < 0.02 * 5000
    assert distribution.over == (values > 2e-3).sum()


def test_coverage_of_uniform_poses():
    """Bins are of equal size: uniform rotations fill them evenly, by the chi-squared statistic."""
    n, random = 40_000, np.random.default_rng(0)
    coverage = Coverage()
    pose = np.hstack([[[0.1, 0.0, 0.0]] * n, Rotation.random(n, random_state=random).as_quat(scalar_first=True)])
    middles = coverage.add(pose_matrix(pose), np.zeros(3))
    np.testing.assert_allclose(middles, pose[:, :3])
    for counts in (coverage.directions, coverage.rotations):
        expected = n / counts.size
        statistic = ((counts - expected) ** 2 / expected).sum()
        assert abs(statistic - counts.size) < 5 * np.sqrt(2 * counts.size)
    share = coverage.numbers(n)["rotations"]
    assert share["share"] == 1.0
    assert share["share_if_uniform"] > 0.99


def test_approach_direction():
    """A hand that stands on the object's +y side, however both are turned, is in the sector of +y."""
    coverage = Coverage()
    for R in Rotation.random(20, random_state=1).as_matrix():
        T = np.eye(4)
        T[:3, :3] = R
        middle, way = np.array([0.3, -0.2, 0.5]), np.array([0.3, 1.0, 0.05])  # object frame
        T[:3, 3] = -R @ (middle + way)  # so the hand's origin is at middle + way
        coverage.add(T[None], middle)
    band, sector = np.unravel_index(coverage.directions.argmax(), coverage.directions.shape)
    assert coverage.directions.max() == 20
    longitude = -180 + 360 * (sector + 0.5) / coverage.directions.shape[1]
    assert longitude == pytest.approx(np.degrees(np.arctan2(1.0, 0.3)), abs=7.5)
    assert band == coverage.directions.shape[0] // 2


def test_principal_postures():
    """Two directions of equal variance among five joints; a joint that never moves; nothing that moves."""
    random = np.random.default_rng(0)
    axes = np.linalg.qr(random.normal(size=(5, 2)))[0]
    scores = np.vstack([np.eye(2), -np.eye(2)])
    q = 0.3 + scores @ axes.T
    posture = principal_postures(4, q.sum(0), q.T @ q)
    np.testing.assert_allclose(posture.share, [0.5, 0.5, 0, 0, 0], atol=1e-12)
    assert posture.dimension == pytest.approx(2)
    np.testing.assert_allclose(np.linalg.norm(posture.scores(q), axis=1), 1)
    assert posture.numbers()["components_for_95_percent"] == 2
    still = principal_postures(3, np.full(5, 0.9), 3 * 0.09 * np.ones((5, 5)))
    assert still.dimension == 0
    assert still.numbers()["components_for_95_percent"] == 0
