"""The simulators that there are: what makes a world of one, and what it tells of itself."""

from importlib.metadata import version
from typing import Any

from lgrasp.choices import EngineName
from lgrasp.runtime.optional import import_mujoco
from lgrasp.simulate import drake_world, physx_world
from lgrasp.simulate.drake_world import DrakeWorld, import_drake
from lgrasp.simulate.model import Model
from lgrasp.simulate.mujoco_world import MujocoWorld
from lgrasp.simulate.physx_world import PhysxWorld, import_physx
from lgrasp.simulate.world import World


def make_world(model: Model) -> World:
    """A world of the simulator that the model's protocol names; O objects in the order of the rows."""
    return {"mujoco": MujocoWorld, "physx": PhysxWorld, "drake": DrakeWorld}[model.protocol.engine](model)


def check_engine(engine: EngineName) -> None:
    """Raises PhysicsError if a simulator, or MuJoCo, which compiles the models of all of them, is not installed."""
    import_mujoco()
    if engine != "mujoco":
        {"physx": import_physx, "drake": import_drake}[engine]()


SOLVERS: dict[EngineName, dict[str, Any]] = {
    "mujoco": {},
    "physx": {"solver": physx_world.SOLVER},
    "drake": {"solver": drake_world.SOLVER},
}
"""What decides the verdicts of a simulator besides the protocol."""


def engine_text(engine: EngineName, device: str) -> str:
    """Name and version of a simulator."""
    if engine == "physx":
        return f"physx by sapien {import_physx().__version__}"
    if engine == "drake":
        return f"drake {version('drake')}"
    return f"{'mujoco' if device == 'cpu' else 'mujoco_warp'} {import_mujoco().__version__}"
