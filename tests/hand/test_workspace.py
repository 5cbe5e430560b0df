"""Workspace and manipulability, where they are known in closed form."""

import pytest
from support.urdfs import BASE, fingers

from lgrasp.hand.build import build_hand
from lgrasp.hand.drafting.import_urdf import import_urdf
from lgrasp.hand.find import find_hand
from lgrasp.hand.spec import Box, ContactRule, HandSpec
from lgrasp.hand.workspace import measure_workspace

AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}


def stage(folder):
    """A ball that three slides move 10 cm each, 30 cm above the base."""
    parts, parent = [], "base"
    for name, axis in AXES.items():
        shape = '<collision><geometry><sphere radius="0.004"/></geometry></collision>' if name == "z" else ""
        origin = '<origin xyz="0 0 0.3"/>' if name == "x" else ""
        parts.append(f'<link name="{name}">{shape}</link><joint name="j{name}" type="prismatic">{origin}')
        parts.append(
            f'<parent link="{parent}"/><child link="{name}"/><axis xyz="{axis}"/><limit lower="0" upper="0.1"/></joint>'
        )
        parent = name
    path = folder / "stage.urdf"
    path.write_text(f'<robot name="stage">{BASE}{"".join(parts)}</robot>')
    box = Box(min=(0, 0, 0.3), max=(0.1, 0.1, 0.4))
    return build_hand(path, HandSpec(name="stage", contact=(ContactRule(links=("z",)),), canonical_box=box))


def test_three_slides(tmp_path):
    """They move the ball one for one in every direction; it reaches a cube, and its radius beyond."""
    found = measure_workspace(stage(tmp_path))
    assert found.manipulability == pytest.approx(1.0, abs=1e-4)
    assert 0.1**3 <= found.volume <= 0.12**3 * 1.01  # whole cells
    assert found.shared == 0.0


def test_planar_fingers_cannot_leave_their_plane(tmp_path):
    made = import_urdf(fingers(tmp_path, 2), out=tmp_path / "made")
    source = find_hand(str(made.folder))
    found = measure_workspace(build_hand(source.urdf, source.spec))
    assert found.manipulability == pytest.approx(0.0, abs=1e-9)
    assert 0 < found.shared < found.volume
