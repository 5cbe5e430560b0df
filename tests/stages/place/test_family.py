"""Poses near others."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lgrasp.grasp.tables import PoseTable
from lgrasp.stages.place.family import move_table
from lgrasp.stages.place.params import PlaceParams
from lgrasp.stages.place.stage import run

COPIES = 400


@pytest.fixture(scope="module")
def drawn(context):
    """drawn(**params): many times the first pose that is placed."""

    def draw(**params):
        arrays = run((0, 300), PlaceParams(**params), context)[0].arrays()
        return PoseTable.of({name: np.repeat(values[:1], COPIES, 0) for name, values in arrays.items()}, "cpu")

    return draw


def moved(table, context, index=None, share=1.0, **params):
    index = np.arange(COPIES) if index is None else index
    return move_table(table, index, PlaceParams(**params), context.with_salt(64), share=share)


def turns(a, b):
    return (Rotation.from_quat(b[:, 3:]) * Rotation.from_quat(a[:, 3:]).inv()).as_rotvec()


def test_moves_have_the_size_that_is_asked_for(context, drawn):
    table = drawn(palm=0)
    new, counts = moved(table, context, share=0.5, family_move=0.004, family_turn=6.0)
    assert counts["tried"] == COPIES
    assert counts["kept"] == len(new) == COPIES - counts["blocked"] > COPIES / 2
    old = table.arrays()["pose"][: len(new)]
    pose, com = new.arrays()["pose"], np.asarray(context.object.model.com)
    centres = [Rotation.from_quat(p[:, 3:]).apply(com) + p[:, :3] for p in (old, pose)]
    np.testing.assert_allclose((centres[1] - centres[0]).std(0), 0.002, rtol=0.25)
    np.testing.assert_allclose(np.degrees(turns(old, pose)).std(0), 3.0, rtol=0.25)


def test_an_object_stays_on_the_palm(context, drawn):
    table = drawn(canonical=0, exhaustive=0, pinch=0, palm=1)
    arrays, hand, obj = moved(table, context)[0].arrays(), context.hand.model, context.object.model
    palm, surface = arrays["palm_point"], arrays["palm_surface"]
    assert len(set(surface.tolist())) > 5
    R = Rotation.from_quat(arrays["pose"][:, 3:])
    at = R.apply(obj.contact_points[surface]) + arrays["pose"][:, :3]
    np.testing.assert_allclose(at, hand.contact_points[palm], atol=1e-5)
    np.testing.assert_allclose(R.apply(obj.contact_normals[surface]), -hand.contact_normals[palm], atol=1e-3)


def test_a_move_belongs_to_its_number(context, drawn):
    table = drawn(palm=0)
    whole = moved(table, context)[0].arrays()
    some = whole["index"][5:9]
    part = PoseTable.of({name: values[: len(some)] for name, values in table.arrays().items()}, "cpu")
    again = moved(part, context, some)[0].arrays()
    for name, values in again.items():
        np.testing.assert_array_equal(values, whole[name][5:9], err_msg=name)


def test_without_moves_all_stay(context, drawn):
    table = drawn(palm=0)
    new = moved(table, context, family_move=0.0, family_turn=0.0)[0]
    np.testing.assert_allclose(new.arrays()["pose"], table.arrays()["pose"], atol=1e-6)
