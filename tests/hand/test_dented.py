"""Dented collision bodies: convex pieces instead of a hull, and link pairs tested on their true surfaces."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
import warp as wp
from support.hands import hand_source, minimal_spec
from support.solids import ELL, YOU, prism

from lgrasp.errors import DecomposeError
from lgrasp.field.kernels import sample_postures
from lgrasp.geometry.decompose import decompose
from lgrasp.geometry.union import joined_mesh
from lgrasp.hand.arrays import Hand, body_poses, upload_hand
from lgrasp.hand.build import build_hand
from lgrasp.hand.geometry import convex_pieces, is_dented
from lgrasp.hand.model import HandModel
from lgrasp.hand.self_collision import OVERLAP, overlap_depth
from lgrasp.hand.urdf import Geometry, Urdf, read_urdf
from lgrasp.runtime.device import KERNEL_OPTIONS, start

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def measure_overlap(hand: Hand, body: wp.array2d(dtype=wp.transform), depth_out: wp.array(dtype=wp.float32)):
    row = wp.tid()
    depth_out[row] = overlap_depth(hand, body, row)


FINGER = """<robot name="slot">
<link name="base"><collision><geometry><mesh filename="slot.stl"/></geometry></collision></link>
<link name="knuckle"/>
<link name="tip"><collision>
<origin xyz="0.01 0 0.016"/><geometry><box size="0.008 {width} 0.02"/></geometry></collision></link>
<joint name="side" type="prismatic"><parent link="base"/><child link="knuckle"/><axis xyz="0 1 0"/>
<limit lower="{low}" upper="{high}"/></joint>
<joint name="rise" type="prismatic"><parent link="knuckle"/><child link="tip"/><axis xyz="0 0 1"/>
<limit lower="0" upper="0.001"/></joint></robot>"""


def slotted(folder: Path, width: float, low: float, high: float) -> HandModel:
    """A box of some width that moves sideways in the slot of a U (12 mm wide) without ever leaving it."""
    prism(YOU).export(folder / "slot.stl")
    (folder / "slot.urdf").write_text(FINGER.format(width=width, low=low, high=high))
    return build_hand(folder / "slot.urdf", minimal_spec("slot", ["tip"]))


def element(mesh: trimesh.Trimesh) -> tuple[Urdf, Geometry, trimesh.Trimesh]:
    """A mesh as a collision element of some URDF."""
    return read_urdf(hand_source("shipped")[0]), Geometry("mesh", (1.0, 1.0, 1.0), np.eye(4), "m.stl"), mesh


def test_dented_mesh_is_cut_and_its_notch_left_empty():
    pieces, said = convex_pieces(*element(prism(ELL)), decompose)
    assert len(pieces) >= 2
    assert said == f"mesh m.stl fills 61 % of its convex hull; {len(pieces)} convex pieces"
    assert min(p.depth(np.array([[0.01, 0.025, 0.025]]))[0] for p in pieces) > 0.004
    surface = np.asarray(prism(ELL).sample(2000, seed=0))
    assert np.min([p.depth(surface) for p in pieces], 0).max() < 7e-4


def test_two_dented_bodies_and_a_plain_one():
    parts = [prism(ELL), prism(YOU).apply_translation([0.1, 0, 0]), trimesh.creation.box((0.01, 0.01, 0.01))]
    parts[2].apply_translation([0.3, 0, 0])
    pieces, said = convex_pieces(*element(joined_mesh(parts)), decompose)
    assert 6 <= len(pieces) <= 9
    assert f"{len(pieces)} convex pieces" in said


def test_convex_and_slightly_dented_meshes_stay_whole():
    def never(*_, **__):
        raise AssertionError

    shallow = YOU.copy()
    shallow[4:6, 1] = 0.017  # 3 mm deep
    for mesh in (trimesh.creation.icosphere(radius=0.02), prism(shallow)):
        assert not is_dented(mesh)
        pieces, said = convex_pieces(*element(mesh), never)
        assert (len(pieces), said) == (1, "")


def test_failure_falls_back_to_the_hull_and_says_so():
    given = element(prism(ELL, 0.021))
    pieces, said = convex_pieces(*given, partial(decompose, timeout=0.01))
    assert len(pieces) == 1
    assert said.endswith("; the hull is used (convex decomposition took longer than 0.01 s)")
    # pieces that leave out some of the surface are refused
    half = prism(ELL).vertices * [1, 1, 0.5]
    pieces, said = convex_pieces(*given, lambda *_, **__: [half])
    assert len(pieces) == 1
    assert "leave out" in said

    def broken(*_, **__):
        raise DecomposeError("no")

    assert convex_pieces(*given, broken)[1].endswith("the hull is used (no)")


def test_pair_in_a_slot_is_tested_on_its_true_surfaces(tmp_path):
    # 1 mm of play to each side, and 3 mm of travel: overlap |side| - 1 mm
    model = slotted(tmp_path, 0.010, -0.003, 0.003)
    assert len(model.pairs) == 0
    assert {tuple(s[:2]) for s in model.overlap_sides} <= {(0, 2), (2, 0)}
    assert len(model.overlap_sides) >= 1
    (note,) = (n for n in model.notes if "overlap" in n)
    assert "'base' and 'tip' overlap by more than 0.85 mm" in note
    assert int(note.split(" % ")[0].split()[-1]) == pytest.approx(100 * (1 - 1.85 / 3), abs=8)

    start()
    hand, n = upload_hand(model, "cpu"), 400
    posture = wp.zeros((n, 16), dtype=wp.uint8, device="cpu")
    clear = wp.zeros(n, dtype=wp.int32, device="cpu")
    wp.launch(sample_postures, dim=n, inputs=[hand.struct, 0, 0, 5, 3e-4], outputs=[posture, clear], device="cpu")
    side = -0.003 + 0.006 * posture.numpy()[:, 0] / 255.0
    overlap = np.maximum(np.abs(side) - 0.001, 0)
    sure = np.abs(overlap - OVERLAP) > 1e-4
    np.testing.assert_array_equal(clear.numpy()[sure], (overlap < OVERLAP)[sure])

    q = np.column_stack([np.linspace(-0.003, 0.003, 31), np.zeros(31)]).astype(np.float32)
    body = wp.array(body_poses(hand, q)[:, 1:], dtype=wp.transform, device="cpu")
    depth = wp.zeros(31, dtype=wp.float32, device="cpu")
    wp.launch(measure_overlap, dim=31, inputs=[hand.struct, body], outputs=[depth], device="cpu")
    np.testing.assert_allclose(depth.numpy(), np.maximum(np.abs(q[:, 0]) - 0.001, 0), atol=1e-4)


def test_pairs_that_always_or_never_overlap_are_not_tested(tmp_path):
    for width, expected in ((0.014, "overlap in every posture; they are not kept apart"), (0.006, "")):
        model = slotted(tmp_path, width, -0.0005, 0.0005)
        assert len(model.pairs) == len(model.overlap_sides) == 0
        notes = [n for n in model.notes if "overlap" in n]
        assert [expected in n for n in notes] == ([True] if expected else [])


def test_a_pair_that_is_apart_in_few_postures_is_tested(tmp_path):
    """0.2 % of the travel is free: a few hundred postures may all overlap, and still the pair can be clear."""
    model = slotted(tmp_path, 0.010, 0.001046, 0.003)
    assert len(model.overlap_sides) >= 1
    assert not any("every posture" in n for n in model.notes)


def test_arrays_of_overlaps_round_trip(tmp_path):
    model = slotted(tmp_path, 0.010, -0.003, 0.003)
    back = HandModel.from_arrays(model.to_arrays())
    np.testing.assert_array_equal(back.overlap_points, model.overlap_points)
    assert back.notes == model.notes
