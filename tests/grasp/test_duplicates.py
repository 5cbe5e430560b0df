"""Near-duplicates against brute force."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.near import new_rows

from lgrasp.grasp.duplicates import NEAR_ANGLE, NEAR_DISTANCE, NEAR_JOINT, KeptRows, near_pairs


def rows(seed: int, n: int, spread: float, joints: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Poses and joints around a few centres; ``spread`` 1 makes about half of the neighbours near."""
    if n == 0:
        return np.zeros((0, 7), np.float32), np.zeros((0, joints), np.float32)
    random = np.random.default_rng(seed)
    centre = random.integers(0, max(1, n // 4), n)
    place = random.uniform(-0.1, 0.1, (n, 3))[centre] + random.normal(0, 0.0015 * spread, (n, 3))
    turn = Rotation.random(n, random_state=seed)[centre] * Rotation.from_rotvec(random.normal(0, 0.02 * spread, (n, 3)))
    q = random.uniform(-1, 1, (n, joints))[centre] + random.normal(0, 0.03 * spread, (n, joints))
    sign = random.choice([-1, 1], (n, 1))
    return np.hstack([place, turn.as_quat() * sign]).astype(np.float32), q.astype(np.float32)


def near(pose: np.ndarray, q: np.ndarray, i: int, j: int) -> bool:
    angle = (Rotation.from_quat(pose[i, 3:]) * Rotation.from_quat(pose[j, 3:]).inv()).magnitude()
    distance = np.linalg.norm(pose[i, :3].astype(float) - pose[j, :3])
    return bool(distance <= NEAR_DISTANCE and angle <= NEAR_ANGLE and np.abs(q[i] - q[j]).max() <= NEAR_JOINT)


def brute_pairs(pose: np.ndarray, q: np.ndarray) -> list[list[int]]:
    return [[i, j] for i in range(len(pose)) for j in range(i + 1, len(pose)) if near(pose, q, i, j)]


def brute_kept(pose: np.ndarray, q: np.ndarray) -> list[int]:
    kept: list[int] = []
    for j in range(len(pose)):
        if not any(near(pose, q, i, j) for i in kept):
            kept.append(j)
    return kept


tables = st.builds(rows, st.integers(0, 2**32 - 1), st.integers(0, 30), st.sampled_from([0.2, 1.0, 3.0]))


@settings(max_examples=25, deadline=None)
@given(tables)
def test_pairs(table):
    assert near_pairs(*table).tolist() == brute_pairs(*table)


@settings(max_examples=25, deadline=None)
@given(tables)
def test_new_rows(table):
    assert np.flatnonzero(new_rows(*table)).tolist() == brute_kept(*table)


@settings(max_examples=25, deadline=None)
@given(tables, st.lists(st.integers(0, 30), max_size=5), st.integers(1, 30))
def test_kept_rows_of_any_cut(table, cuts, room):
    pose, q = table
    kept, store, duplicates = [], KeptRows(q.shape[1]), 0
    for part in np.split(np.arange(len(pose)), sorted(min(c, len(pose)) for c in cuts)):
        if store.count < room:
            new, dropped = store.add(pose[part], q[part], room - store.count)
            kept += part[new].tolist()
            duplicates += dropped
    expected = brute_kept(pose, q)[:room]
    assert kept == expected
    assert store.count == len(kept)
    last = expected[-1] + 1 if len(expected) == room else len(pose)
    assert duplicates == last - len(expected)


def test_many_rows_in_small_parts():
    pose, q = rows(0, 1000, 1.0)
    store = KeptRows(q.shape[1])
    kept = [i + new for i in range(0, 1000, 7) for new in store.add(pose[i : i + 7], q[i : i + 7], 1000)[0].tolist()]
    assert kept == np.flatnonzero(new_rows(pose, q)).tolist()
    assert len(near_pairs(pose[kept], q[kept])) == 0


@pytest.mark.parametrize("n", [0, 1])
def test_few_rows(n):
    pose, q = rows(0, n, 1.0)
    assert near_pairs(pose, q).shape == (0, 2)
    assert new_rows(pose, q).tolist() == [True] * n


def test_same_row_many_times():
    pose, q = rows(0, 1, 1.0)
    pose, q = np.repeat(pose, 50, 0), np.repeat(q, 50, 0)
    assert new_rows(pose, q).sum() == 1
    assert len(near_pairs(pose, q)) == 50 * 49 // 2
