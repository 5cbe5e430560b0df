"""Grasps that touch regions of the object and avoid others, told from the rows alone."""

import shutil

import numpy as np
import pytest
import trimesh

from lgrasp.errors import ConfigError
from lgrasp.judge.run import judge

HANDLE = "box:0.026,-1,-1:1,1,1"
TOP, LOW = "box:-1,-1,0.06:1,1,1", "box:-1,-1,-1:1,1,0.06"


def contacts(shard):
    """Rows, points [m] and normal forces of all contacts."""
    rows = shard.grasps
    row, *place = np.nonzero(rows.contact_links >= 0)
    push = -(rows.contact_forces * rows.contact_normals).sum(axis=-1)
    return row, rows.contact_points[row, *place], push[row, *place]


def passes(path):
    report = judge(path)
    assert report.passed
    assert report.values["touch_missing"].max() == 0.0
    assert report.values["avoid_contacts"].max() == 0.0


def test_all_contacts_touch(steered):
    shard, path = steered(touch=TOP)
    assert contacts(shard)[1][:, 2].min() >= 0.06
    points, touch, avoid = np.split(shard.objects[0].regions, [3, 4], axis=1)
    np.testing.assert_array_equal(touch[:, 0] > 0, points[:, 2] >= 0.06)
    assert not avoid.any()
    assert shard.objects[0].touch_share == 1.0
    passes(path)


def test_no_contact_is_on_what_is_avoided(steered):
    shard, path = steered(avoid=[TOP, "box:-1,-1,-1:1,1,0.02"])
    z = contacts(shard)[1][:, 2]
    assert 0.02 < z.min() < z.max() < 0.06
    passes(path)


def test_a_handle_is_found(steered):
    """Contacts are drawn on it, not filtered: a candidate gives at least 30 % of the handle's part in the grasps."""
    handle, path = steered(rows=20, touch=HANDLE)
    whole, _ = steered(rows=20)
    mesh = trimesh.Trimesh(whole.objects[0].vertices, whole.objects[0].faces)
    surface = mesh.area_faces[mesh.triangles_center[:, 0] >= 0.026].sum() / mesh.area
    assert 0.05 < surface < 0.15
    rate, unrestricted = (shard.statistics["filter_kept"] / shard.statistics["candidates"] for shard in (handle, whole))
    assert rate >= 0.3 * unrestricted * surface
    assert contacts(handle)[1][:, 0].min() >= 0.026
    passes(path)


def test_share_of_the_force(steered, swift):
    shard, path = steered(swift.with_table(), touch=f"{TOP}:0.6")
    row, points, push = contacts(shard)
    on = points[:, 2] >= 0.06
    share = np.bincount(row, push * on) / np.bincount(row, push)
    assert share.min() >= 0.6 - 1e-5
    assert not on.all()
    assert shard.statistics["filter_touch"] > 0
    assert shard.objects[0].touch_share == pytest.approx(0.6)
    passes(path)


def test_grasps_of_a_second_meshs_inside(steered, tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    (tmp_path / "ball.ply").write_bytes(ball.export(file_type="ply"))
    shard, path = steered(touch=str(tmp_path / "ball.ply"))
    assert np.linalg.norm(contacts(shard)[1], axis=1).max() < 0.0506
    passes(path)


def test_regions_are_in_the_key(job, swift, tmp_path):
    mesh, copy = trimesh.creation.icosphere(radius=0.05), tmp_path / "copy" / "part.ply"
    part = tmp_path / "part.ply"
    part.write_bytes(mesh.export(file_type="ply"))
    copy.parent.mkdir()
    shutil.copy(part, copy)

    def key(**asked):
        return job(pipeline=swift.with_steering(**asked)).key()

    assert key(touch=str(part)) == key(touch=str(copy))
    keys = [key(), key(touch=TOP), key(avoid=TOP), key(touch=f"{TOP}:0.5"), key(touch=LOW), key(touch=str(part))]
    copy.write_bytes(mesh.apply_scale(0.9).export(file_type="ply"))
    assert len({*keys, key(touch=str(copy)), key(touch=f"{part}:0.5")}) == len(keys) + 2


def test_regions_that_leave_nothing(run, swift):
    for asked, words in (
        ({"touch": "sphere:1,1,1:0.01"}, "sphere:1,1,1:0.01.*none of the"),
        ({"touch": TOP, "avoid": TOP}, "--avoid leaves none"),
        ({"touch": "group:handle"}, "no group 'handle'"),
    ):
        with pytest.raises(ConfigError, match=words):
            run(pipeline=swift.with_steering(**asked))
    with pytest.raises(ConfigError, match="no share can follow"):
        swift.with_steering(avoid=f"{TOP}:0.5")
