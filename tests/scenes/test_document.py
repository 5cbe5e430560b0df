"""docs/guides/scenes.md names every member of the format and every parameter with its default."""

import re

import yaml
from support.places import ROOT

from lgrasp.cloud.suffixes import CLOUD_SUFFIXES
from lgrasp.jobs.scenes.job import SceneJob
from lgrasp.scenes.schema import ATTRIBUTES, DATASETS, FORMAT, FORMAT_VERSION

TEXT = (ROOT / "docs" / "guides" / "scenes.md").read_text(encoding="utf-8")
NAMES = {"f4": "float32", "i4": "int32", "i2": "int16", "u2": "uint16", "u8": "uint64", "?": "bool"}


def test_every_dataset_with_its_type_and_shape():
    for spec in DATASETS:
        assert f"`{spec.path}`" in TEXT, spec.path
        if spec.path.split("/")[0] in ("scene", "views", "cloud", "grasps"):
            shape = ", ".join(map(str, spec.shape))
            assert f"- `{spec.path}` ({NAMES[spec.dtype]} [{shape}]): " in TEXT, spec.path


def test_every_attribute():
    for spec in ATTRIBUTES:
        assert f"`{spec.name}`" in TEXT, spec.name
    assert f"`{FORMAT}`" in TEXT
    assert f"`{FORMAT_VERSION}`" in TEXT


def test_every_key_with_its_default():
    (block,) = re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL)
    shown = yaml.safe_load(block) | {"objects": [], "hand": None}
    assert SceneJob(**shown).model_dump() == SceneJob().model_dump()


def test_every_suffix_of_clouds():
    assert all(f"`{suffix}`" in TEXT for suffix in CLOUD_SUFFIXES if suffix != ".h5")
