"""What a simulation of one hand and its objects can do, in any simulator."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from lgrasp.simulate.model import Model


class World(ABC):
    """One hand and its objects in a simulator: set, driven, pushed, stepped and read.

    O objects and B bodies as MuJoCo counts them, K columns of q. A world serves one thread.

    Args:
        model: O objects in the order of the rows.
    """

    def __init__(self, model: Model) -> None:
        self._model = model

    @abstractmethod
    def begin(self, q: np.ndarray, poses: np.ndarray) -> None:
        """Hand at q (K,), objects' centres of mass at poses (O, 7) in the base frame, everything at rest."""

    @abstractmethod
    def drive(self, targets: np.ndarray) -> None:
        """Set the targets of the drives (nu,) [rad or m]."""

    def push(self, forces: np.ndarray) -> None:
        """Pull on the objects' centres of mass from now on (O, 3) [N], world frame."""
        still = np.zeros(3)
        self.press({int(body): (force, still) for body, force in zip(self._model.object_body, forces, strict=True)})

    @abstractmethod
    def press(self, loads: dict[int, tuple[np.ndarray, np.ndarray]]) -> None:
        """Forces (3,) [N] on the centres of mass of bodies, and torques (3,) [N m], from now on, world frame; nothing
        on others."""

    @abstractmethod
    def place_table(self, pose: np.ndarray) -> None:
        """Put the table, whose top is z = 0 of its frame, at a pose (7,) in the world."""

    @abstractmethod
    def slide_table(self, by: np.ndarray) -> None:
        """In the next step the table moves by a vector (3,) [m] and nothing else, whatever presses on it."""

    @abstractmethod
    def step(self, steps: int) -> None:
        """Go on for some steps of the protocol."""

    @abstractmethod
    def state(self) -> Any:
        """Everything that decides what comes next."""

    @abstractmethod
    def restore(self, state: Any) -> None:
        """Inverse of :meth:`state`."""

    @abstractmethod
    def objects(self) -> np.ndarray:
        """Poses of the objects' centres of mass (O, 7), world frame."""

    @abstractmethod
    def velocities(self) -> np.ndarray:
        """Linear [m/s] and angular [rad/s] velocities of the objects (O, 6)."""

    @abstractmethod
    def frames(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (B, 3) [m] and rotations (B, 3, 3) of the bodies in the world."""

    @abstractmethod
    def touching(self) -> np.ndarray:
        """Both bodies of each contact (n, 2)."""

    def links_touching(self) -> np.ndarray:
        """Number of the hand's bodies in contact with each object (O,)."""
        bodies, objects = self.touching(), self._model.object_body
        hand = np.ones(self._model.mujoco.nbody, bool)
        hand[objects] = False
        found = np.zeros(len(objects), int)
        for number, body in enumerate(objects):
            others = np.unique(bodies[(bodies == body).any(1)].sum(1) - body)
            found[number] = hand[others].sum()
        return found

    def on_table(self) -> bool:
        """Whether an object touches the table."""
        bodies, objects = self.touching(), self._model.object_body
        return bool(((bodies == self._model.table.body).any(1) & np.isin(bodies, objects).any(1)).any())

    @abstractmethod
    def deepest(self) -> float:
        """Deepest penetration of any object, in a link or in another object [m]."""

    @abstractmethod
    def wild(self) -> bool:
        """True if the simulation has diverged."""
