"""An object as kernels read it."""

import numpy as np

from lgrasp.geometry.clusters import CLUSTER_SIZE
from lgrasp.runtime.fetch import to_numpy


def test_balls_hold_all_contact_points(inputs):
    obj = inputs.object.model
    balls = to_numpy(inputs.object.struct.contact_sphere)
    run = np.arange(len(obj.contact_points)) // CLUSTER_SIZE
    assert len(balls) == run[-1] + 1
    assert (np.linalg.norm(obj.contact_points - balls[run, :3], axis=1) <= balls[run, 3]).all()
    assert np.median(balls[:, 3]) < 0.5 * obj.radius
