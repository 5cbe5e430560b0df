"""``lgrasp render``."""

import numpy as np
import pytest
from PIL import Image
from support.places import TINY_SHARD

SHARD = TINY_SHARD


def test_pictures_of_rows(cli, tmp_path):
    done = cli("render", SHARD, "--rows", "0,9", "--size", 40, "-o", "two.png", "--json", "-")
    assert done.code == 0, done
    assert '"rows": [\n    0,\n    9\n  ]' in done.out
    with Image.open(tmp_path / "two.png") as image:
        assert image.format == "PNG"
        assert image.width == 80
        assert len(np.unique(np.asarray(image))) > 50, "nothing is drawn"


def test_stages_differ(cli, tmp_path):
    for stage in ("pregrasp", "grasp"):
        assert cli("render", SHARD, "-n", 1, "--size", 40, "--stage", stage, "-o", f"{stage}.png").code == 0
    assert (tmp_path / "pregrasp.png").read_bytes() != (tmp_path / "grasp.png").read_bytes()


def test_a_gif_moves_through_the_stages(cli, tmp_path):
    assert cli("render", SHARD, "--rows", "3", "--size", 40, "-o", "grasp.gif").code == 0
    with Image.open(tmp_path / "grasp.gif") as image:
        frames = []
        for number in range(getattr(image, "n_frames", 1)):
            image.seek(number)
            frames.append(image.convert("RGB").tobytes())
    assert len(set(frames)) == len(frames) > 10
    assert cli("render", SHARD, "--rows", "3", "--size", 40, "--stage", "squeeze", "-o", "still.gif").code == 0
    with Image.open(tmp_path / "still.gif") as image:
        assert getattr(image, "n_frames", 1) == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--rows", "3,x"], "--rows '3,x': give numbers"),
        (["--rows", "10"], "row 10 does not exist; there are 0 to 9"),
        (["-o", "grid.bmp"], "grid.bmp cannot be written: name a file that ends in .png"),
    ],
)
def test_bad_input_is_one_line(cli, tmp_path, options, words):
    assert words in cli("render", SHARD, *options).error()
    assert not list(tmp_path.iterdir())
