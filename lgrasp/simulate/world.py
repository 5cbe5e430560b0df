"""What a simulation of one hand and its objects can do, in any simulator."""

from typing import Any, Protocol

import numpy as np


class World(Protocol):
    """One hand and its objects in a simulator: set, driven, pushed, stepped and read.

    O objects, B bodies and J joints as MuJoCo counts them, K columns of q. A world serves one thread.
    """

    def begin(self, q: np.ndarray, poses: np.ndarray) -> None:
        """Hand at q (K,), objects at poses (O, 7) in the base frame, everything at rest."""

    def drive(self, targets: np.ndarray) -> None:
        """Set the targets of the drives (nu,) [rad or m]."""

    def push(self, forces: np.ndarray) -> None:
        """Pull on the objects' centres of mass from now on (O, 3) [N], world frame."""

    def place_table(self, pose: np.ndarray) -> None:
        """Put the table, whose top is z = 0 of its frame, at a pose (7,) in the world."""

    def slide_table(self, by: np.ndarray) -> None:
        """In the next step the table moves by a vector (3,) [m] and nothing else, whatever presses on it."""

    def step(self, steps: int) -> None:
        """Go on for some steps of the protocol."""

    def state(self) -> Any:
        """Everything that decides what comes next."""

    def restore(self, state: Any) -> None:
        """Inverse of :meth:`state`."""

    def objects(self) -> np.ndarray:
        """Poses of the objects (O, 7), world frame."""

    def velocities(self) -> np.ndarray:
        """Linear [m/s] and angular [rad/s] velocities of the objects (O, 6)."""

    def hand_joints(self) -> np.ndarray:
        """Positions of the hand's joints in the order of the model (J,) [rad or m]."""

    def frames(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (B, 3) [m] and rotations (B, 3, 3) of the bodies in the world."""

    def links_touching(self) -> np.ndarray:
        """Number of the hand's bodies in contact with each object (O,)."""

    def on_table(self) -> bool:
        """Whether an object touches the table."""

    def deepest(self) -> float:
        """Deepest penetration of any object, in a link or in another object [m]."""

    def wild(self) -> bool:
        """True if the simulation has diverged."""
