"""Objects dropped on a table, simulated by MuJoCo until they lie still."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from lgrasp.errors import PhysicsError, short_reason
from lgrasp.geometry.poses import canonical, pose_matrix, shifted
from lgrasp.runtime.optional import import_mujoco
from lgrasp.scenes.params import DropParams
from lgrasp.simulate.builder import add_solid, set_contact, set_options
from lgrasp.simulate.protocol import DENSITY, Physics
from lgrasp.simulate.solid import Solid

_STILL = (2.0e-3, 0.02)  # [m/s], [rad/s] below which an object lies still
_QUIET = 0.2  # [s] for which it must
_THICK = 0.1  # [m] of the table
_SINK = 2.0e-3  # [m] an object may sink into the table at rest


class Settled(NamedTuple):
    """Objects at rest on a table."""

    pose: np.ndarray
    """T_scene_object, x y z [m] qw qx qy qz with qw >= 0, shape (n, 7), f64."""
    tries: int
    """How often they were dropped until all stayed."""
    seconds: float
    """Simulated time until they lay still [s]."""


def drop(solids: Sequence[Solid], table: float, params: DropParams, rng: np.random.Generator) -> Settled:
    """Drop objects near the middle of a square table, each turned at random; those that roll off are dropped again.

    The scene frame has its origin in the middle of the table's top, z up.

    Args:
        table: side [m].

    Raises:
        PhysicsError: MuJoCo is missing or refuses an object, or the objects never came to rest on the table.
    """
    mujoco, names = import_mujoco(), ", ".join(f"'{solid.name}'" for solid in solids)
    try:
        model = _model(mujoco, solids, table, params)
    except (ValueError, RuntimeError) as error:
        raise PhysicsError(f"MuJoCo refuses objects {names}: {short_reason(error, 300)}") from None
    data = mujoco.MjData(model)
    for number in range(1, params.tries + 1):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = _start(solids, params, rng).ravel()
        seconds = _settle(mujoco, model, data, params)
        if seconds is None:
            continue
        centred = data.qpos.reshape(-1, 7)
        pose = shifted(centred, -np.stack([solid.center for solid in solids]))
        if _on_table(solids, pose, table):
            return Settled(np.hstack([pose[:, :3], canonical(pose[:, 3:])]), number, seconds)
    raise PhysicsError(
        f"objects {names} did not come to rest on a table of {table:g} m in {params.tries} tries; "
        "use fewer objects, a larger table or a longer drop"
    )


def _model(mujoco: Any, solids: Sequence[Solid], table: float, params: DropParams) -> Any:
    spec = mujoco.MjSpec()
    physics = Physics(timestep=params.timestep, friction=params.friction, torsion=0.005, impratio=5.0, noslip=0)
    set_options(mujoco, spec, physics, weightless=False)
    half = 0.5 * table
    top = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[half, half, 0.5 * _THICK])
    top.pos = [0, 0, -0.5 * _THICK]
    for k, solid in enumerate(solids):
        add_solid(mujoco, spec, f"object {k}", solid, DENSITY * solid.volume, DENSITY * solid.inertia)
    for geom in spec.geoms:
        set_contact(geom, physics, 6, rolling=0.001)  # so that balls come to rest
        geom.solref = [2.5 * params.timestep, 1.0]
    return spec.compile()


def _start(solids: Sequence[Solid], params: DropParams, rng: np.random.Generator) -> np.ndarray:
    """Random poses of centres of mass (n, 7), each as low as the table and the balls around earlier objects allow."""
    pose = np.empty((len(solids), 7))
    radius = np.array([max(np.linalg.norm(p - s.center, axis=1).max() for p in s.pieces) for s in solids])
    for k in range(len(solids)):
        turn, way = canonical(rng.standard_normal(4)), 2.0 * np.pi * rng.random()
        away = params.radius * np.sqrt(rng.random())
        x, y = away * np.cos(way), away * np.sin(way)
        # lowest height at which the ball around it is clear of the table and of earlier balls
        height = radius[k] + params.gap
        for i in range(k):
            reach = radius[k] + radius[i] + params.gap
            rest = reach**2 - (x - pose[i, 0]) ** 2 - (y - pose[i, 1]) ** 2
            if rest > 0.0:
                height = max(height, pose[i, 2] + np.sqrt(rest))
        pose[k] = x, y, height, *turn
    return pose


def _settle(mujoco: Any, model: Any, data: Any, params: DropParams) -> float | None:
    """Simulate until nothing has moved for a while; the time [s], or None when that never happened."""
    chunk, quiet = max(1, round(0.02 / params.timestep)), 0.0
    while data.time < params.longest:
        for _ in range(chunk):
            mujoco.mj_step(model, data)
        if not np.isfinite(data.qpos).all() or (data.qpos.reshape(-1, 7)[:, 2] < -1.0).any():
            return None
        speed = np.abs(data.qvel.reshape(-1, 2, 3)).max(axis=(0, 2))
        quiet = quiet + chunk * params.timestep if (speed < _STILL).all() else 0.0
        if quiet >= _QUIET:
            return float(data.time)
    return None


def _on_table(solids: Sequence[Solid], pose: np.ndarray, table: float) -> bool:
    """True if every object is above the table and none has sunk into it."""
    for solid, T in zip(solids, pose_matrix(pose), strict=True):
        points = np.vstack(solid.pieces) @ T[:3, :3].T + T[:3, 3]
        if np.abs(points[:, :2]).max() > 0.5 * table or points[:, 2].min() < -_SINK:
            return False
    return True
