"""The palmar side by rays."""

import numpy as np
import pytest

from lgrasp.engine.cache import Cache
from lgrasp.hand.surface_visibility import visible_surface
from lgrasp.jobs.shard_inputs import named_hand


@pytest.fixture
def hand(cache_root):
    """hand(name): where a hand comes from, and its model."""
    return lambda name: named_hand(Cache(cache_root, pytest.fail), name)


@pytest.mark.parametrize(("name", "palm"), [("barrett", [0, 0, 1]), ("schunk_svh", [1, 0, 0])])
def test_what_the_fingertips_see_faces_them(name, palm, hand):
    source, model = hand(name)
    side = visible_surface(source, model)
    still = side.body == 0
    assert still.any()
    assert set(side.body) > {0}
    facing = side.normals[still].mean(0)
    assert facing @ palm > 0.8 * np.linalg.norm(facing)
    assert (np.diff(side.link) >= 0).all()
    # hand.yaml's own rule for the fingers' surface agrees in most places
    links = set(side.link)
    assert {int(link) for link in model.contact_link} <= links
