"""Protocols that shake and turn a hand that holds objects.

All is told from the hand, whose base stands still as in every protocol: the objects feel their weight, which turns, and
the inertia of the hand's acceleration. The turns are slow, their inertia is left out.
"""

import numpy as np

from lgrasp.simulate.lift import smooth
from lgrasp.simulate.protocol import GRAVITY, Protocol, Shake
from lgrasp.simulate.verdict import AXES

_ORDER = (0, 2, 4, 1, 3, 5)  # of AXES: each at a right angle to the one before
_WAVES = 4  # of each axis


def shake_course(protocol: Protocol) -> dict[int, np.ndarray]:
    """What pulls at the objects in each step, over their weight, base frame.

    Returns:
        For each direction of gravity, by its place in AXES and in the order in which the hand goes through them, the
        way to it and the hold there, (T, 3). On the way to the first the hand is shaken.
    """
    shake, dt = protocol.shake, protocol.timestep
    assert shake
    hold = np.ones((max(1, round(protocol.hold / dt)), 1))
    angle = 0.5 * np.pi * smooth(max(1, round(shake.turning / dt)))[1:, None]
    course: dict[int, np.ndarray] = {}
    for before, k in zip((None, *_ORDER), _ORDER, strict=False):
        if before is None:
            way = AXES[k] - _shaking(shake, dt) / GRAVITY
        else:
            way = np.cos(angle) * AXES[before] + np.sin(angle) * AXES[k]
        course[k] = np.concatenate([way, hold * AXES[k]])
    return course


def _shaking(shake: Shake, dt: float) -> np.ndarray:
    """Acceleration of the hand in each step (n, 3) [m/s^2]: along each axis a sum of sines."""
    rng, time = np.random.default_rng(shake.seed), dt * np.arange(1, 1 + max(1, round(shake.shaking / dt)))
    frequency, phase = rng.uniform(*shake.frequency, (_WAVES, 3)), rng.uniform(0.0, 2 * np.pi, (_WAVES, 3))
    push = np.sin(2 * np.pi * frequency * time[:, None, None] + phase).sum(1)
    return shake.acceleration * push / np.linalg.norm(push, axis=1).max()
