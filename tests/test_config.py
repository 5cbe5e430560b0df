"""Declarations: old keys are read for one release, unknown ones fail."""

from typing import ClassVar

import pytest

from lgrasp.config import Params, parse_model
from lgrasp.engine.registry import STAGES
from lgrasp.errors import ConfigError


class Stage(Params):
    RENAMED: ClassVar = {"slack": "allowed_penetration"}

    allowed_penetration: float = 0.001


def test_old_key_is_read_and_said_once(said):
    for _ in range(2):
        assert parse_model(Stage, {"slack": 0.002}, "pipeline mine, stage ik").allowed_penetration == 0.002
    assert said == [
        "pipeline mine, stage ik: 'slack' is now called 'allowed_penetration'; the old name works in this release only"
    ]


def test_new_key_says_nothing(said):
    assert parse_model(Stage, {"allowed_penetration": 0.002}, "here").allowed_penetration == 0.002
    assert Stage().allowed_penetration == 0.001
    assert said == []


def test_both_keys_fail(said):
    with pytest.raises(ConfigError, match="'slack' is the old name of 'allowed_penetration'"):
        parse_model(Stage, {"slack": 0.002, "allowed_penetration": 0.001}, "here")


def test_unknown_key_names_the_nearest(said):
    with pytest.raises(ConfigError, match="did you mean 'allowed_penetration'"):
        parse_model(Stage, {"allowed_penetrations": 0.002}, "here")


def test_stages_read_their_old_names(said):
    for stage in STAGES.values():
        fields = stage.params.model_fields
        for old, new in getattr(stage.params, "RENAMED", {}).items():
            assert old not in fields
            read = parse_model(stage.params, {old: fields[new].default}, "old file")
            assert read == stage.params()
            assert f"old file: '{old}' is now called '{new}'; the old name works in this release only" in said
