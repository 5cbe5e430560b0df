"""Made-up shards of real kinematics."""

import pytest
from support.exported import hand_record, make_shard, object_record


@pytest.fixture(scope="session")
def shards():
    """For tests: make(path, ...), hand(name, real), object(name, digit, scale)."""

    class Shards:
        make = staticmethod(make_shard)
        hand = staticmethod(hand_record)
        object = staticmethod(object_record)

    return Shards
