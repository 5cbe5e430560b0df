"""Where the depth cameras stand around a table."""

import numpy as np

from lgrasp.picture.camera import Intrinsics, central_camera, look_at
from lgrasp.scenes.params import CameraParams


def intrinsics_of(params: CameraParams) -> Intrinsics:
    """Square pixels, the optical axis through the middle of the image."""
    return central_camera(params.width, params.height, params.angle)


def place_cameras(params: CameraParams, rng: np.random.Generator) -> np.ndarray:
    """Poses T_scene_camera, shape (v, 7), of cameras evenly around the origin, from a random direction on."""
    azimuth = 2.0 * np.pi * (rng.random() + np.arange(params.views) / params.views)
    elevation = np.radians(rng.uniform(*params.elevation, params.views))
    distance = rng.uniform(*params.distance, params.views)
    level = np.cos(elevation)
    direction = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
    return look_at(distance[:, None] * direction, np.zeros(3))
