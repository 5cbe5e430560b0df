"""Made-up shards that conform."""

import pytest
from support.shards import assert_same_rows, sample_sequence, sample_shard


@pytest.fixture(scope="session")
def make_shard():
    return sample_shard


@pytest.fixture(scope="session")
def make_sequence():
    return sample_sequence


@pytest.fixture(scope="session")
def same_rows():
    return assert_same_rows
