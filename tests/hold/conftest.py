"""Hands and objects of the hold test, made once."""

import pytest
import trimesh
from support.holding import HALF, RADIUS, flat, pointed_hand, sliding, solid, turning

from lgrasp.hand.arrays import HandArrays
from lgrasp.object.arrays import ObjectArrays


@pytest.fixture(scope="session")
def two_fingers(tmp_path_factory) -> HandArrays:
    """They slide along x."""
    return pointed_hand(tmp_path_factory.mktemp("two"), sliding(2))


@pytest.fixture(scope="session")
def two_plates(tmp_path_factory) -> HandArrays:
    """The same with plates for tips, which touch at four points each."""
    return pointed_hand(tmp_path_factory.mktemp("plates"), flat(sliding(2)))


@pytest.fixture(scope="session")
def two_known_fingers(tmp_path_factory) -> HandArrays:
    """The same; distances from their tips are known."""
    return pointed_hand(tmp_path_factory.mktemp("known"), sliding(2), ["pad", "tip0", "tip1"])


@pytest.fixture(scope="session")
def three_fingers(tmp_path_factory) -> HandArrays:
    """They slide towards the z axis, 120 degrees apart."""
    return pointed_hand(tmp_path_factory.mktemp("three"), sliding(3))


@pytest.fixture(scope="session")
def two_levers(tmp_path_factory) -> HandArrays:
    """They turn about y and press along x at an arm of ARM."""
    return pointed_hand(tmp_path_factory.mktemp("levers"), turning())


@pytest.fixture(scope="session")
def box() -> ObjectArrays:
    return solid(trimesh.creation.box((2 * HALF, 0.06, 0.06)))


@pytest.fixture(scope="session")
def ball() -> ObjectArrays:
    return solid(trimesh.creation.icosphere(5, RADIUS))
