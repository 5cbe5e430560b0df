"""One draw of a protocol's random numbers: what it is, and a compiled model that is given it."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lgrasp.runtime.optional import import_mujoco
from lgrasp.simulate.model import Model
from lgrasp.simulate.protocol import Draws

_NUMBERS = ("friction", "torsion", "mass", "stiffness", "damping_ratio", "softness")


class Draw(NamedTuple):
    """Numbers of one simulation of O objects; :class:`lgrasp.simulate.protocol.Draws` says what they mean."""

    friction: float
    torsion: float  # [m]
    mass: float  # [kg]
    stiffness: float  # [N m/rad]
    damping_ratio: float
    softness: float  # [s]
    shifts: np.ndarray  # (O, 3) [m]
    turns: np.ndarray  # (O, 3) axis times angle [rad]

    def placed(self, poses: np.ndarray) -> np.ndarray:
        """Poses of objects' centres of mass (O, 7) with the draw's error."""
        before = Rotation.from_quat(np.asarray(poses[:, 3:], float), scalar_first=True)
        after = Rotation.from_rotvec(self.turns) * before
        return np.concatenate([poses[:, :3] + self.shifts, after.as_quat(scalar_first=True)], axis=1)


def draw_of(draws: Draws, candidate: int, number: int, objects: int) -> Draw:
    """A row's draw of some number, a function of these and the seed alone."""
    rng = np.random.default_rng([draws.seed, candidate, number])
    ends = np.array([getattr(draws, name) for name in _NUMBERS])
    numbers = ends[:, 0] + rng.random(len(ends)) * (ends[:, 1] - ends[:, 0])
    errors = [(_in_ball(rng, draws.shift), _in_ball(rng, np.radians(draws.turn))) for _ in range(objects)]
    shifts, turns = np.array(errors).swapaxes(0, 1)
    return Draw(**dict(zip(_NUMBERS, numbers.tolist(), strict=True)), shifts=shifts, turns=turns)


def _in_ball(rng: np.random.Generator, radius: float) -> np.ndarray:
    """A point (3,) evenly from a ball."""
    way = rng.standard_normal(3)
    return radius * np.cbrt(rng.random()) * way / np.linalg.norm(way)


def tune(model: Model, compiled: Model, draw: Draw) -> None:
    """Give a model the numbers of a draw, as if it had been compiled with them.

    Args:
        model: changed; :meth:`lgrasp.simulate.model.Model.own` of ``compiled``.
    """
    mujoco, m, before, bodies = import_mujoco(), model.mujoco, compiled.mujoco, model.object_body
    m.geom_friction[:, :2] = draw.friction, draw.torsion
    m.geom_solref[:, 0] = draw.softness
    m.body_mass[bodies] = draw.mass
    m.body_inertia[bodies] = before.body_inertia[bodies] * (draw.mass / before.body_mass[bodies])[:, None]
    stiffer, damped = draw.stiffness / model.protocol.stiffness, draw.damping_ratio / model.protocol.damping_ratio
    m.actuator_gainprm[:, 0] = before.actuator_gainprm[:, 0] * stiffer
    m.actuator_biasprm[:, 1] = before.actuator_biasprm[:, 1] * stiffer
    m.actuator_biasprm[:, 2] = before.actuator_biasprm[:, 2] * damped * np.sqrt(stiffer)  # 2 ratio sqrt(gain inertia)
    mujoco.mj_setConst(m, mujoco.MjData(m))
    m.stat.meaninertia = m.dof_M0.mean()
