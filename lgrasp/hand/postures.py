"""Where the bodies of a hand are at given postures, and which of its fingers are clear there."""

from dataclasses import dataclass

import numpy as np

from lgrasp.geometry.poses import device_rotation
from lgrasp.hand.arrays import body_poses, upload_hand
from lgrasp.hand.model import HandModel
from lgrasp.hand.pairs import pieces_touch
from lgrasp.runtime.device import start

SAMPLED_POSTURES = 1200
"""Random postures that tell what fingers can reach."""

_Index = int | slice | list[int] | np.ndarray


@dataclass(frozen=True)
class Postures:
    """Random postures: body rotations (N, B, 3, 3), positions (N, B, 3) [m] and which fingers are clear (N, G)."""

    q: np.ndarray  # (N, K)
    R: np.ndarray
    t: np.ndarray
    clear: np.ndarray  # (N, G) of the static base and of itself
    touching: np.ndarray  # (N,) do any two parts touch?

    def turn(self, rows: _Index, bodies: _Index, normals: np.ndarray) -> np.ndarray:
        """Directions (n, 3) of bodies in the base frame; postures, bodies and directions broadcast."""
        return np.einsum("...ij,...j->...i", self.R[rows, bodies], normals)

    def place(self, rows: _Index, bodies: _Index, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) [m] of bodies in the base frame; postures, bodies and points broadcast."""
        return self.turn(rows, bodies, points) + self.t[rows, bodies]

    def put(
        self, rows: int | np.ndarray, bodies: int | np.ndarray, points: np.ndarray, normals: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """:meth:`place` and :meth:`turn` of as many points as directions (n, 3), which gathers each pose once."""
        at = np.broadcast_to(rows * self.R.shape[1] + bodies, len(points))
        R, t = (a.reshape(-1, *a.shape[2:]).take(at, 0) for a in (self.R, self.t))
        p, n = (np.einsum("nij,nj->ni", R, a) for a in (points, normals))
        return p + t, n


def sample_bodies(model: HandModel, q: np.ndarray) -> Postures:
    """Body poses at postures q (N, K), and which of them are clear."""
    start()
    poses = body_poses(upload_hand(model, "cpu"), q)
    R = device_rotation(poses.reshape(-1, 7)).as_matrix().reshape(*poses.shape[:2], 3, 3)
    touch = pieces_touch(model, q, model.pairs)
    group = model.tree.body_group[model.piece_body[model.pairs]]  # (Q, 2), the base is -1
    own = [(group[:, 1] == g) & ((group[:, 0] == -1) | (group[:, 0] == g)) for g in range(model.groups)]
    clear = np.stack([~touch[:, pairs].any(1) for pairs in own], 1)
    return Postures(q, R, poses[..., :3].astype(float), clear, np.asarray(touch.any(1)))
