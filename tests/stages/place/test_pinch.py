"""place, source pinch: two opposite points of the object between two fingers that press towards each other."""

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from support.field import query_field
from support.urdfs import fingers

from lgrasp.hand.drafting.import_urdf import import_urdf
from lgrasp.object.arrays import upload_object
from lgrasp.object.params import ObjectParams
from lgrasp.object.preprocess import preprocess_object
from lgrasp.stages.context import Context
from lgrasp.stages.place.params import PlaceParams
from lgrasp.stages.place.stage import run


def test_two_fingers_can_touch_both_anchors(context, inputs):
    params = PlaceParams(canonical=0, exhaustive=0, palm=0, pinch=1, proposals=1)
    table, counts = run((0, 400), params, context)
    arrays, hand, obj = table.arrays(), inputs.hand.model, inputs.object.model
    assert counts["kept"] == len(table) > 40
    R, t = Rotation.from_quat(arrays["pose"][:, 3:]), arrays["pose"][:, :3]
    reached = []
    for g in range(hand.groups):
        a = arrays["anchor"][:, g]
        p = R.apply(obj.contact_points[a]) + t
        n = -R.apply(obj.contact_normals[a])
        slot = arrays["setting"] * hand.groups + g
        found = query_field(inputs.field, slot, p, n, angle=np.pi)
        assert (found[a >= 0] >= 0).all(), "an anchor is a point that its finger can touch"
        reached.append(np.where((a >= 0)[:, None], p, np.nan))
    assert (np.isfinite(np.array(reached)).all(2).sum(0) >= 2).all()


def test_fingers_that_bend_in_one_plane_hold_flat_faces(load, tmp_path):
    """Their normals lie in planes of the base frame, as those of a box that is put between them do."""
    hand = import_urdf(fingers(tmp_path, 2), out=tmp_path / "hand").folder
    inputs = load("tiny", hand=str(hand))
    cube = upload_object(preprocess_object(trimesh.creation.box((0.05, 0.05, 0.05))), "cpu")
    context = Context(inputs.hand, cube, inputs.field, "cpu", 0, 0)
    table, _ = run((0, 200), PlaceParams(canonical=0, exhaustive=0, palm=0, pinch=1), context)
    assert len(table) > 100


def test_opposite_points_face_away_from_each_other():
    params = ObjectParams(contact_count=1024)
    ball = preprocess_object(trimesh.creation.icosphere(subdivisions=4, radius=0.03), params=params)
    j = ball.contact_opposite
    assert (j >= 0).mean() > 0.99
    line = ball.contact_points[j] - ball.contact_points
    line /= np.linalg.norm(line, axis=1)[:, None]
    cosine = np.cos(np.radians(30.0)) - 1e-4
    assert (np.einsum("nd,nd->n", line, ball.contact_normals[j]) > cosine).all()
    assert (np.einsum("nd,nd->n", line, -ball.contact_normals) > cosine).all()


def test_the_wall_of_a_bowl_has_no_opposite_through_its_cavity_only_beyond_it():
    """Both walls of a tube count: what is pressed from outside, right across the hole."""
    tube = trimesh.creation.annulus(r_min=0.027, r_max=0.03, height=0.06)
    model = preprocess_object(tube, params=ObjectParams(contact_count=1024))
    radius = np.linalg.norm(model.contact_points[:, :2], axis=1)
    outer = (radius > 0.0295) & (np.abs(model.contact_normals[:, 2]) < 0.1)
    j = model.contact_opposite[outer]
    width = np.linalg.norm(model.contact_points[j] - model.contact_points[outer], axis=1)[j >= 0]
    assert (j >= 0).mean() > 0.9
    assert np.median(width) > 0.05
