"""Pictures: what is seen is where it is, in its colour, whole."""

import numpy as np
import pytest
import trimesh

from lgrasp.picture.draw import Painted, choose_viewpoint, draw
from lgrasp.picture.sheet import sheet

SIZE = 48
WHITE = 255


@pytest.fixture(scope="module")
def ball():
    return trimesh.creation.icosphere(subdivisions=3, radius=0.04)


@pytest.fixture(scope="module")
def bar():
    return trimesh.creation.box((0.02, 0.02, 0.2)).apply_translation([0.06, 0, 0])


def reddish(picture):
    """Where red is well above green and blue."""
    colour = picture.astype(int)
    return colour[..., 0] > colour[..., 1:].max(-1) + 40


def test_the_whole_scene_is_in_the_picture(ball, bar):
    view = choose_viewpoint([bar], [ball], np.zeros((0, 3)), SIZE)
    picture = draw([Painted(bar, "#2040ff"), Painted(ball, "#20c020")], np.zeros((0, 3)), view)
    border = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
    assert (border == WHITE).all()
    tall = (picture != WHITE).any((1, 2)).sum()
    assert tall > 0.85 * SIZE, "it is smaller than need be"
    colour = picture.astype(int)
    assert (colour[..., 1] > colour[..., [0, 2]].max(-1) + 40).any(), "the ball is not seen"
    assert (colour[..., 2] > colour[..., :2].max(-1) + 40).any(), "the bar is not seen"


def test_the_object_is_seen_from_where_the_hand_does_not_hide_it(ball):
    wall = trimesh.creation.box((0.01, 0.2, 0.2)).apply_translation([0.05, 0, 0])
    view = choose_viewpoint([wall], [ball], np.zeros((0, 3)), SIZE)
    assert view.pose[0] < 0.05, "the camera is behind the wall"


def test_a_hidden_contact_shows_through(ball):
    view = choose_viewpoint([], [ball], np.zeros((0, 3)), 4 * SIZE)
    towards = view.pose[None, :3] / np.linalg.norm(view.pose[:3])
    plain, seen, hidden = (
        draw([Painted(ball, "#808080")], dots, view) for dots in (np.zeros((0, 3)), 0.04 * towards, -0.039 * towards)
    )
    assert not reddish(plain).any()
    assert reddish(seen).sum() > 9
    assert reddish(hidden).sum() > 9
    assert hidden[reddish(hidden)].min(0)[1] > seen[reddish(seen)].min(0)[1], "it is as red as one in front"


def test_sheet():
    tiles = [np.full((40, 60, 3), 10 * i, np.uint8) for i in range(5)]
    plain = sheet(tiles)
    assert plain.size == (180, 80)  # 3 x 2
    assert plain.getpixel((70, 50)) == (40, 40, 40)
    told = sheet(tiles, ["row 1"] * 5, columns=5)
    assert told.width == 300
    assert told.height > 40
    assert np.asarray(told)[40:, :60].min() < 128, "no caption"
    long = np.asarray(sheet(tiles, ["a hand with a long name · row 1"] * 5, columns=5))[40:]
    assert long[:, 5:55].min() < 128
    assert (long[:, 58:62] == WHITE).all(), "captions touch each other"
