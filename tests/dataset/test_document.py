"""docs/reference/file-format.md names every member of the format, and its examples run."""

import re
import subprocess
import sys

import pytest
from support.places import ROOT

from lgrasp.dataset.writer import write_shard
from lgrasp.grasp.schema import ATTRIBUTES, DATASETS, FORMAT_VERSION, SEQUENCE_DATASETS, TABLE_FIELDS

TEXT = (ROOT / "docs" / "reference" / "file-format.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)


def test_every_member_is_documented():
    assert f"version {FORMAT_VERSION}" in TEXT
    for spec in (*DATASETS, *SEQUENCE_DATASETS, *TABLE_FIELDS.values()):
        assert f"`{spec.path}`" in TEXT, spec.path
    for attribute in ATTRIBUTES:
        assert f"`{attribute.name}`" in TEXT, attribute.name


@pytest.mark.parametrize("code", EXAMPLES)
def test_examples_run(tmp_path, make_shard, make_sequence, code):
    write_shard(tmp_path / "allegro-mug-00000.h5", make_shard(6))
    write_shard(tmp_path / "four-00000.h5", make_sequence())
    subprocess.run([sys.executable, "-W", "error", "-c", code], cwd=tmp_path, check=True, capture_output=True)
