"""Files of every format version ever released stay readable, with exactly the values they were written with."""

import json
from pathlib import Path

import numpy as np
import pytest

from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard

GOLDEN = Path(__file__).parent / "golden"


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.h5")), ids=lambda p: p.stem)
def test_archived_shard_is_readable(path):
    expected = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    assert validate_shard(path) == []
    shard = read_shard(path)
    for name, value in expected["header"].items():
        assert getattr(shard.header, name) == value
    _assert_record(shard.hand, expected["hand"] | {"meshes": None})
    assert {name: blob.hex() for name, blob in shard.hand.meshes.items()} == expected["hand"]["meshes"]
    for record, values in zip(shard.objects, expected["objects"], strict=True):
        _assert_record(record, values)
    columns = shard.grasps.columns()
    assert set(columns) == set(expected["columns"])
    for name, stored in expected["columns"].items():
        assert columns[name].dtype == stored["dtype"]
        np.testing.assert_array_equal(columns[name], np.array(stored["values"], dtype=stored["dtype"]), err_msg=name)
    assert shard.grasps.metric_units == expected["metric_units"]
    assert shard.grasps.physics_protocols == expected["physics_protocols"]
    assert shard.statistics == expected["statistics"]
    sequence = shard.grasps.sequence
    assert (sequence and list(sequence.space_names)) == expected.get("space_names")


def _assert_record(record, expected):
    for name, value in expected.items():
        if value is not None:
            actual = getattr(record, name)
            np.testing.assert_array_equal(actual, np.array(value, dtype=getattr(actual, "dtype", None)), err_msg=name)
