"""The judge finds contacts that are not where a shard says they are."""

import h5py
import numpy as np
import pytest
from support.jawshard import row, write_shard

from lgrasp.judge.bounds import JudgeError
from lgrasp.judge.run import judge

SIDES = np.array([[x, y, z] for x in (-0.01, 0.01) for y in (-0.02, 0.02) for z in (-0.01, 0.01)])
ON, BOTH, NONE = SIDES[:, 1] > 0, np.ones(8), np.zeros(8)


def judged(path, touch, avoid, share=1.0):
    """The jaws squeeze the sides y = 0.02 m and -0.02 m of the cube, with half of the force each."""
    write_shard(path, [row()])
    with h5py.File(path, "a") as file:
        cube = file["objects/a_cube"]
        cube["regions"] = np.column_stack([SIDES, touch, avoid]).astype("f4")
        cube.attrs["touch_share"] = share
    return judge(path)


@pytest.mark.parametrize(
    ("touch", "avoid", "share", "missing", "there"),
    [
        (BOTH, NONE, 1.0, 0.0, 0),
        (0.4 + 0.2 * ON, NONE, 1.0, 0.5, 0),
        (ON, NONE, 0.5, 0.0, 0),
        (ON, NONE, 0.6, 0.1, 0),
        (BOTH, ON, 1.0, 0.0, 1),
        (BOTH, 0.4 * BOTH, 1.0, 0.0, 0),
        (NONE, BOTH, 1.0, 1.0, 2),
    ],
)
def test_contacts_in_regions(tmp_path, touch, avoid, share, missing, there):
    report = judged(tmp_path / "s.h5", touch, avoid, share)
    assert report.values["touch_missing"][0] == pytest.approx(missing, abs=1e-6)
    assert report.values["avoid_contacts"][0] == there
    found = {name for name, mask in report.failed.items() if mask[0]}
    assert found == ({"touch"} if missing else set()) | ({"avoid"} if there else set())


def test_without_regions_nothing_is_asked(tmp_path):
    report = judge(write_shard(tmp_path / "s.h5", [row()]))
    assert report.passed
    assert np.isnan(report.values["touch_missing"]).all()


@pytest.mark.parametrize(("touch", "share"), [(BOTH, 0.0), (BOTH, 1.5), (np.nan * BOTH, 1.0)])
def test_regions_that_cannot_be(tmp_path, touch, share):
    with pytest.raises(JudgeError, match="regions"):
        judged(tmp_path / "s.h5", touch, NONE, share)
