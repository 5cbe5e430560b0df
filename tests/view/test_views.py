"""What the viewer shows, by what it holds; no browser."""

import socket
import sys
from dataclasses import replace
from http.client import HTTPConnection

import numpy as np
import pytest
from support.jaws import jaw_rows, jaw_shard
from support.places import TINY_SHARD
from support.twins import twin_rows, twin_shard

from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.errors import ConfigError
from lgrasp.grasp.records import SequenceRows
from lgrasp.picture.camera import Intrinsics
from lgrasp.picture.scene import STAGES, HandShape, scene_of_row
from lgrasp.scenes.files import write_scene
from lgrasp.scenes.records import CloudRecord, SceneGrasps, SceneRecord, ViewsRecord
from lgrasp.view.front import Front

SHARD = TINY_SHARD


@pytest.fixture(scope="module")
def epsilon():
    return read_shard(SHARD).grasps.metrics["epsilon"]


@pytest.fixture(scope="module")
def rows(opened):
    return opened(SHARD, row=3)[1]


@pytest.fixture(scope="module")
def hand(opened):
    return opened("allegro")[1]


def height(scene) -> float:
    return float(np.ptp(scene.bounds, axis=0)[2])


def test_it_begins_at_the_row_that_was_asked(rows):
    assert list(rows.shown) == [3]
    assert "lgrasp view" in rows.told
    assert "--row 3" in rows.told


def asked(site, path: str) -> tuple[int, str, str]:
    """Status, where it leads, text."""
    connection = HTTPConnection("127.0.0.1", site.front.port, timeout=20)
    connection.request("GET", path)
    answer = connection.getresponse()
    told = answer.status, answer.getheader("Location", ""), answer.read().decode()
    connection.close()
    return told


def test_a_link_opens_its_row(opened, epsilon):
    site, rows = opened(SHARD, where=["metrics/epsilon > 0.05"])
    for row in (int(np.argmax(epsilon)), int(np.argmin(epsilon))):  # the last does not meet the condition
        assert asked(site, f"/row/{row}")[:2] == (302, "/")
        assert list(rows.shown) == [row]
        assert f"](/row/{row})" in rows.told
    assert list(rows.order) == list(range(10))
    assert asked(site, "/row/10") == (404, "", "row 10 does not exist; there are 0 to 9")
    assert list(rows.shown) == [row]


def test_all_else_is_viser(opened):
    site, _ = opened("tiny")
    status, _, text = asked(site, "/")
    assert (status, "<html" in text) == (200, True)
    assert asked(site, "/row/0")[::2] == (404, "there are no rows here")
    import viser
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    version = Subprotocol(f"viser-v{viser.__version__}")
    with connect(f"ws://127.0.0.1:{site.front.port}", subprotocols=[version], max_size=None) as socket:
        assert len(socket.recv(timeout=20)) > 1000


def test_a_link_waits_until_rows_are_there(opened):
    told = []
    opened(SHARD, served=lambda site: told.append(asked(site, "/row/3")))
    assert told == [(503, "", "loading")]


def test_conditions_and_order_choose_rows(rows, epsilon):
    rows.choose(where="metrics/epsilon > 0.05", sort="metrics/epsilon")
    good = np.flatnonzero(epsilon > 0.05)
    assert list(rows.order) == good[np.argsort(-epsilon[good], kind="stable")].tolist()
    assert list(rows.shown) == [int(rows.order[0])]
    with pytest.raises(ConfigError, match="no row of 10 meets"):
        rows.choose(where="metrics/epsilon > 9")
    rows.choose(where="")
    assert list(rows.order) == list(range(10))


def test_rows_side_by_side_do_not_touch(rows):
    rows.choose(where="", side=4)
    assert list(rows.shown) == [0, 1, 2, 3]
    names = {name.split("/")[1] for name in rows.meshes().geometry}
    assert names == {"grasp0", "grasp1", "grasp2", "grasp3"}
    rows.choose(where="", side=1)
    assert {name.split("/")[1] for name in rows.meshes().geometry} == {"grasp0"}


def test_a_row_before_the_first_is_the_first(rows):
    rows.show(-3)
    assert list(rows.shown) == [0]


def test_the_address_can_be_opened_elsewhere():
    front = Front("0.0.0.0", 0, 1)
    assert front.url == f"http://{socket.gethostname()}:{front.port}"
    front.close()


def test_time_moves_the_hand(rows):
    tips = []
    for time in (0.0, 1.0):
        rows.move(time)
        tips.append(np.concatenate([m.vertices for n, m in rows.meshes().geometry.items() if "tip" in n]))
    assert np.abs(tips[1] - tips[0]).max() > 0.001


def test_a_sequence_begins_at_its_last_grasp(opened, tmp_path):
    """With all objects; before it those that are held alone, to which contacts belong."""
    rows = twin_rows(count=2)
    rows.q_pregrasp[1, :2] = rows.q[1, :2]  # of the first object's gripper, in the second step
    steps = {name: np.repeat(getattr(rows, name)[:, None], 2, 1) for name in STAGES.values()}
    steps["q_pregrasp"][1, 0] = steps["q_pregrasp"][0, 0]
    space, free = np.tile(np.array([0, 1], "i2"), (2, 1)), np.array([[[1, 1, 0, 0], [0, 0, 1, 1]]] * 2, bool)
    names = "object_index", "contact_links", "object_pose", "contact_points", "contact_normals", "contact_forces"
    changed = {name: getattr(rows, name).copy() for name in names}
    free[0, 1] = False  # the first row has one object
    for values in (space, *steps.values(), *changed.values()):
        values[0, 1] = -1 if values.dtype.kind == "i" else np.nan
    own = SequenceRows(space_names=("a", "b"), space=space, free_joints=free, parent=np.array([-1, 0]), **steps)
    shard = twin_shard(replace(rows, **changed, sequence=own))
    write_shard(tmp_path / "a.h5", shard)
    both = scene_of_row(HandShape.of_record(shard.hand), shard.objects, shard.grasps, 1)
    assert both.contacts.of.tolist() == [0, 0, 1, 1]
    view = opened(tmp_path, row=1)[1]

    def shown() -> set[str]:
        return {name.rpartition("/")[2] for name in view.meshes().geometry if "object" in name}

    assert shown() == {"object0", "object1"}
    view.move(1.0)
    assert shown() == {"object0"}
    view.go(0)
    view.go(1)  # which has more steps
    assert shown() == {"object0", "object1"}


def test_a_hand_takes_postures(hand):
    first = hand.meshes().bounds
    hand.take(np.full(16, 9.9))  # beyond the limits, so at them
    assert np.abs(hand.meshes().bounds - first).max() > 0.01


@pytest.mark.parametrize("layer", ["contact patches", "palmar side", "collision pieces", "canonical box"])
def test_layers_come_and_go(hand, layer):
    assert hand.show(layer, True) > 0
    assert hand.show(layer, False) == 0


def test_an_object(opened):
    view = opened("tiny")[1]
    (mesh,) = view.meshes().geometry.values()
    assert len(mesh.faces) > 10


def test_a_scene(opened, tmp_path):
    """Two grasps of a cube on a table, of which the second is free of collision and comes first."""
    (tmp_path / "urdf").mkdir()
    shard = jaw_shard(tmp_path / "urdf", jaw_rows(0.002, count=2))
    at = np.array([[0, 0, 0.02, 1, 0, 0, 0]], "f4")
    hand_pose = np.array([[0, 0, 0.3, 1, 0, 0, 0], [0, 0, 0.4, 1, 0, 0, 0]], "f4")
    depth = np.array([[0.0, 0.01], [0.0, 0.0]], "f4")
    scene = SceneRecord(
        seed=0,
        index=3,
        hand=shard.hand,
        objects=shard.objects,
        table=0.5,
        object_index=np.zeros(1, "i4"),
        object_pose=at,
        views=ViewsRecord(
            intrinsics=Intrinsics(2, 2, 1.0, 1.0, 0.5, 0.5),
            pose=at,
            offset=np.zeros((1, 3), "f4"),
            depth=np.zeros((1, 2, 2), "u2"),
            labels=np.full((1, 2, 2), -1, "i2"),
        ),
        cloud=CloudRecord(
            points=np.zeros((1, 3), "f4"),
            normals=np.array([[0, 0, 1]], "f4"),
            labels=np.ones(1, "i2"),
            view=np.zeros(1, "i2"),
        ),
        grasps=SceneGrasps(
            target=np.zeros(2, "i4"),
            hand_pose=hand_pose,
            q=shard.grasps.q,
            q_pregrasp=shard.grasps.q_pregrasp,
            q_squeeze=shard.grasps.q_squeeze,
            table_depth=depth,
            object_depth=np.zeros((2, 2), "f4"),
            collision_free=np.array([False, True]),
            candidate=np.arange(2, dtype="u8"),
            tolerance=0.001,
        ),
    )
    write_scene(tmp_path / "scene.h5", scene)
    site, view = opened(tmp_path)
    shown = view.meshes()
    cube, palm = shown.geometry["object0"], shown.graph.get("base")[0]
    np.testing.assert_allclose(cube.bounds.mean(0), [0, 0, 0.02], atol=1e-6)
    assert palm[2, 3] == pytest.approx(0.4)
    assert asked(site, "/row/0")[:2] == (302, "/")
    assert view.meshes().graph.get("base")[0][2, 3] == pytest.approx(0.3)
    assert "table" in shown.geometry
    assert opened(tmp_path, row=1)[1].meshes().graph.get("base")[0][2, 3] == pytest.approx(0.4)
    for options, message in (({"row": 2}, "row 2 does not exist"), ({"where": ["metrics/epsilon"]}, "has no metrics")):
        with pytest.raises(ConfigError, match=message):
            opened(tmp_path, **options)


@pytest.mark.parametrize(
    ("what", "options", "message"),
    [
        ("allegrp", {}, "'allegrp' is no file, folder, hand or object; did you mean 'allegro'"),
        (SHARD, {"row": 10}, "row 10 does not exist; there are 0 to 9"),
        ("allegro", {"row": 3}, "--row is for grasps; hand allegro has no rows"),
        (SHARD, {"where": ["epsilon >"]}, "expected COLUMN or COLUMN OP NUMBER"),
        (SHARD, {"where": ["metrics/epsilon > 9"]}, "no row of 10 meets"),
    ],
)
def test_what_cannot_be_shown_is_said(opened, what, options, message):
    with pytest.raises(ConfigError, match=message):
        opened(what, **options, served=lambda _: pytest.fail("browsers have an answer"))


def test_without_viser_the_extra_is_named(opened, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ConfigError, match=r'pip install "lgrasp\[view\]"'):
        opened(SHARD)
