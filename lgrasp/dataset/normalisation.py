"""Means and deviations that bring grasps to one scale for a network, measured once."""

from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import torch
from pydantic import Field

from lgrasp.dataset.files import Paths, given_paths
from lgrasp.dataset.json_file import JsonFile
from lgrasp.dataset.split import Split
from lgrasp.dataset.torch_stream import GraspIterableDataset
from lgrasp.errors import ConfigError
from lgrasp.geometry.poses import TO_DEVICE, TO_STORED
from lgrasp.geometry.rotations import (
    inverse_motion,
    matrix_from_sixd,
    motion_from_pose,
    pose_from_motion,
    sixd_from_matrix,
)
from lgrasp.words import listed

_ROWS = 65_536  # at a time
_LEAST = 1e-6  # a number that varies less stays as it is


class Normalisation(JsonFile):
    """Of vectors of a grasp: where the hand is in the frame of the (first) object, how it is turned, and its joints."""

    FORMAT: ClassVar[str] = "lgrasp normalisation"
    VERSION: ClassVar[int] = 1
    MADE_BY: ClassVar[str] = "lgrasp dataset normalisation"

    hand: str = Field(description="Name of the hand.")
    hand_sha256: str = Field(description="Its hash.")
    rows: int = Field(ge=1, description="Rows that were measured.")
    names: tuple[str, ...] = Field(description="x y z [m], six of the rotation's first two columns, joints [rad or m].")
    mean: tuple[float, ...] = Field(description="Of each number of a vector.")
    std: tuple[float, ...] = Field(description="Standard deviations of these.")

    @classmethod
    def of(
        cls, paths: Paths, *, split: Split | str | Path | None = None, part: str | None = None, negatives: bool = False
    ) -> Self:
        """Measure the rows of shards of one hand; arguments and errors as of :class:`GraspIterableDataset`."""
        data = GraspIterableDataset(
            paths,
            columns=["q", "object_pose"],
            batch=_ROWS,
            buffer=0,
            rank=0,
            ranks=1,
            split=split,
            part=part,
            negatives=negatives,
        )
        hand = data.hand()
        shift, sums, squares, rows = np.zeros(1), np.zeros(1), np.zeros(1), 0
        for batch in data:
            vectors = grasp_vectors(batch["object_pose"], batch["q"]).double().cpu().numpy()
            shift = shift if rows else vectors.mean(0)
            sums, squares = sums + (vectors - shift).sum(0), squares + ((vectors - shift) ** 2).sum(0)
            rows += len(vectors)
        if not rows:
            raise ConfigError(f"{listed([str(path) for path in given_paths(paths)], 3)}: no rows to measure")
        mean = sums / rows
        std = np.sqrt(np.maximum(squares / rows - mean**2, 0))
        names = (*("x", "y", "z"), *(f"R{i}{j}" for j in (0, 1) for i in range(3)), *hand.joint_names)
        numbers = {"mean": (mean + shift).tolist(), "std": std.tolist()}
        return cls(hand=hand.name, hand_sha256=hand.sha256, rows=rows, names=names, **numbers)

    def encode(self, object_pose: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Vectors (B, 9 + K) of mean 0 and deviation 1, as the rows measured have it.

        Args:
            object_pose: in the hand base frame, of the first object, x y z [m] qw qx qy qz, (B, O, 7) or (B, 7).
            q: joints [rad or m], (B, K).
        """
        mean, std = self._scale(q)
        return (grasp_vectors(object_pose, q) - mean) / std

    def decode(self, vectors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The inverse for any vectors (B, 9 + K): object pose in the hand base frame (B, 7), joints (B, K)."""
        mean, std = self._scale(vectors)
        vectors = vectors * std + mean
        pose = pose_from_motion(*inverse_motion(matrix_from_sixd(vectors[..., 3:9]), vectors[..., :3]))
        return pose[..., TO_STORED], vectors[..., 9:]

    def _scale(self, like: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean, std = (like.new_tensor(numbers) for numbers in (self.mean, self.std))
        return mean, torch.where(std > _LEAST, std, torch.ones_like(std))


def grasp_vectors(object_pose: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Hand base in the frame of the first object, position [m] and 6D rotation, and joints: (B, 9 + K).

    Args:
        object_pose: in the hand base frame, x y z [m] qw qx qy qz, (B, O, 7) or (B, 7).
        q: joints [rad or m], (B, K).
    """
    pose = object_pose[:, 0] if object_pose.ndim == 3 else object_pose
    R, t = inverse_motion(*motion_from_pose(pose[:, TO_DEVICE]))
    return torch.cat([t, sixd_from_matrix(R), q], -1)
