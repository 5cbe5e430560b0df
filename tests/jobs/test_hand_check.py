"""Trying a hand: numbers, pictures, and reasons that are true of hands spoilt on purpose."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from matplotlib import image
from support.places import QUICK
from support.urdfs import gripper

from lgrasp.dataset.reader import read_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.inputs import Inputs, input_keys, load_inputs
from lgrasp.engine.pipeline import Pipeline, load_pipeline
from lgrasp.engine.run import run as generate
from lgrasp.field.params import FieldParams
from lgrasp.hand.drafting.import_urdf import import_urdf
from lgrasp.hand.find import find_hand
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.hand_check.check import check_hand, check_objects
from lgrasp.jobs.hand_check.diagnose import diagnose, field_vectors, hand_findings
from lgrasp.object.find import find_object
from lgrasp.object.load import load_mesh
from lgrasp.runtime.device import resolve_device


@pytest.fixture(scope="module")
def jaws(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a drafted gripper."""
    folder = tmp_path_factory.mktemp("jaws")
    return import_urdf(gripper(folder), out=folder / "jaws").folder


def spoil(jaws: Path, folder: Path, **changes: object) -> str:
    """A copy of the gripper with keys of hand.yaml replaced."""
    rules = yaml.safe_load((jaws / "hand.yaml").read_text())
    (folder / "hand.yaml").write_text(yaml.safe_dump(rules | changes))
    (folder / "hand.urdf").write_bytes((jaws / "hand.urdf").read_bytes())
    return str(folder)


def test_drafted_gripper_holds_all_three(jaws, tmp_path, cache_root):
    quick = load_pipeline(QUICK)
    found = check_hand(str(jaws), quick, out=tmp_path, rows=10, device="cpu", workers=1, cache=Cache(cache_root))
    assert [o.name for o in found.objects] == ["sphere", "box", "cylinder"]
    assert [o.rows for o in found.objects] == [10, 10, 10]
    assert all(o.reasons == [] for o in found.objects)
    assert found.hints == []
    assert [(s.name, s.problem) for s in found.spaces] == [("finger_1-finger_2", "")]
    assert found.longest_sequence == 1
    assert all(list(o.survivors) == list(quick.order) for o in found.objects)
    assert [p.name for p in found.pictures] == ["hand.png", "palmar.png", "workspace.png", "spaces.png", "grasps.png"]
    for picture in found.pictures:
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert picture.stat().st_size > 20_000
    red, amber, grey = share_of_colours(tmp_path / "palmar.png")
    assert 0.001 < red < 0.1  # the jaw, a last link
    assert 0.001 < amber < 0.1  # the static one
    assert grey > 0.005  # their backs


def test_a_jaw_that_is_the_base_stands_in_for_a_finger(small_job, tmp_path):
    """Both jaws have one drive: contacts are that of the other jaw and the palm's."""
    jaws = import_urdf(gripper(tmp_path, mimic=True), out=tmp_path / "jaws").folder
    more = {"hand": str(jaws), "object": "sphere", "scale": 0.6, "rows": 5, "out": tmp_path / "out"}
    outcome = generate(GenerateJob(**small_job | more))
    assert outcome.rows == 5
    links = read_shard(outcome.paths[0]).grasps.contact_links[:, 0]
    assert ((links >= 0).sum(1) == 2).all()


def share_of_colours(picture: Path) -> tuple[float, ...]:
    """Share of a picture's pixels that are red, amber and grey, of any brightness but white and black."""
    rgb = image.imread(picture)[..., :3]
    r, g, b = np.moveaxis(rgb, -1, 0)
    lit = (rgb.max(-1) > 0.3) & (rgb.max(-1) < 0.93)
    colours = (g < 0.4 * r) & (b < 0.4 * r), (g > 0.6 * r) & (b < 0.4 * r), np.ptp(rgb, axis=-1) < 0.05
    return tuple(float((lit & colour).mean()) for colour in colours)


def load_hand(hand: str, swift: Pipeline, cache_root: Path) -> Inputs:
    field = FieldParams(records=5000)
    keys = input_keys(find_hand(hand), "tiny", 1.0, swift.object, field)
    return load_inputs(Cache(cache_root), keys, 1.0, swift.object, field, resolve_device("cpu"))


def load_findings(hand: str, swift: Pipeline, cache_root: Path) -> dict[str, list[str]]:
    inputs = load_hand(hand, swift, cache_root)
    return hand_findings(inputs.hand.model, inputs.field.model, dict(inputs.keys.source.spec.fingers))


def test_nothing_is_wrong_with_the_draft(jaws, swift, cache_root):
    assert not any(load_findings(str(jaws), swift, cache_root).values())


def test_box_out_of_reach_is_named(jaws, tmp_path, swift, cache_root):
    far = {"min": [0.3, 0.3, 0.3], "max": [0.34, 0.34, 0.34]}
    inputs = load_hand(spoil(jaws, tmp_path, canonical_box=far), swift, cache_root)
    counts = {"place": {"tried": 1000, "kept": 900}, "domain": {"poses": 900, "rich": 0, "candidates": 0}}
    lines = diagnose(inputs, counts, rows=0, asked=10)
    assert lines[0].startswith("domain: 0 of 900 survive")
    assert lines[1].startswith("domain: canonical box is outside 2 of 2 fingers' reach (finger_1, finger_2): move")
    # the remedy is where the draft put the box
    said = yaml.safe_load(lines[1].split("move canonical_box to ")[1])
    drafted = yaml.safe_load((jaws / "hand.yaml").read_text())["canonical_box"]
    assert np.allclose([said["min"], said["max"]], [drafted["min"], drafted["max"]], atol=0.02)
    assert diagnose(inputs, counts, rows=10, asked=10) == []


def test_surfaces_that_never_face_and_a_box_inside_the_palm_are_named(jaws, tmp_path, swift, cache_root):
    outside = [
        {"links": ["jaw_l"], "forbidden": [{"axis": [-1, 0, 0], "angle": 120}]},
        {"links": ["jaw_r"], "forbidden": [{"axis": [1, 0, 0], "angle": 120}]},
    ]
    inside = {"min": [-0.04, -0.02, -0.02], "max": [0.04, 0.02, 0.02]}
    hand = spoil(jaws, tmp_path, contact=outside, palm={}, canonical_box=inside)
    found = load_findings(hand, swift, cache_root)
    assert any("never face each other" in line for line in found["search"])
    assert any("inside static links" in line for line in found["place"])


def test_jaws_that_open_too_little_are_named(jaws, tmp_path, swift, cache_root):
    hand = spoil(jaws, tmp_path, palm={})
    urdf = tmp_path / "hand.urdf"
    urdf.write_text(urdf.read_text().replace('upper="0.05"', 'upper="0.02"'))
    (line,) = load_findings(hand, swift, cache_root)["search"]
    assert "face each other they are at most 4" in line  # 40 mm, along the surfaces a little more


def test_field_vectors_are_contacts_of_the_finger(inputs: Inputs):
    points, normals = field_vectors(inputs.field.model, 0, inputs.hand.model.groups)
    assert len(points) > 1000
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0, abs=1e-6)
    reach = np.linalg.norm(points - inputs.hand.model.tree.T_parent_joint[0][:3, 3], axis=1)
    assert reach.max() < 0.2  # the finger's length


def test_objects_are_closed_and_of_5_cm(tmp_path):
    for name, path in check_objects(tmp_path).items():
        mesh = load_mesh(find_object(path))
        assert mesh.closed
        extents = np.sort(np.ptp(mesh.vertices, axis=0))
        assert extents == pytest.approx([0.05, 0.05, 0.1 if name == "cylinder" else 0.05], abs=2e-4)
