"""The shipped sample objects are what their script builds."""

import pytest
import trimesh
import yaml
from support.places import ROOT
from support.samples import SAMPLES, build_sample, write_samples

from lgrasp.object.find import find_object
from lgrasp.object.preprocess import preprocess_object

SHIPPED = ROOT / "objects"


@pytest.mark.parametrize("name", SAMPLES)
def test_shipped_mesh(name):
    mesh = trimesh.load_mesh(find_object(name))
    built = build_sample(name)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    assert len(mesh.faces) < 5000
    assert mesh.extents == pytest.approx(built.extents, abs=2e-5)
    assert mesh.volume == pytest.approx(built.volume, rel=1e-3)
    assert mesh.volume > 0.0
    assert mesh.bounds[0, 2] == pytest.approx(0.0, abs=2e-6)
    assert 0.06 < mesh.extents.max() < 0.3
    entry = yaml.safe_load((SHIPPED / "objects.yaml").read_text(encoding="utf-8"))[name]
    assert entry["file"] == f"{name}.obj"
    assert entry["licence"] == "Apache-2.0"
    assert entry["faces"] == len(mesh.faces)
    assert entry["extents"] == pytest.approx(mesh.extents, abs=1e-6)
    assert entry["description"] == SAMPLES[name].__doc__


def test_folder_lists_what_it_holds(tmp_path):
    listed = yaml.safe_load((SHIPPED / "objects.yaml").read_text(encoding="utf-8"))
    assert set(listed) == {p.stem for p in SHIPPED.glob("*.obj")} == set(SAMPLES)
    assert not list(SHIPPED.rglob("*.py"))


def test_writing_is_deterministic(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    for one, two in zip(write_samples(tmp_path / "a"), write_samples(tmp_path / "b"), strict=True):
        assert one.read_bytes() == two.read_bytes()


def test_special_shapes():
    assert trimesh.load_mesh(find_object("mug")).euler_number == 0  # a handle with a hole
    assert len(trimesh.load_mesh(find_object("tiny")).faces) < 200
    assert trimesh.load_mesh(find_object("plate")).extents.min() < 0.006


@pytest.mark.parametrize("name", ["bowl", "hammer", "tiny"])
def test_every_sample_can_be_preprocessed(fast, name):
    model = preprocess_object(find_object(name), params=fast)
    assert model.notes == []
    assert len(model.contact_points) > 0.3 * fast.contact_count
