"""Hands on a device: bases in an object's frame and joint positions."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.runtime.fetch import to_numpy


@dataclass(frozen=True)
class Hands:
    """Hands on a device."""

    pose: wp.array
    """Base in the object's internal frame, (N,) transform."""
    q: wp.array
    """Joint positions [rad or m], (N, K) float32."""

    @classmethod
    def put(cls, pose: np.ndarray, q: np.ndarray, device: str) -> "Hands":
        """Of device poses (N, 7), and joint positions (N, K)."""
        poses = wp.array(pose, dtype=wp.transform, device=device)
        return cls(poses, wp.array(q, dtype=wp.float32, device=device))

    def taken(self, rows: np.ndarray) -> "Hands":
        """Some of them, by index; copied on the device."""
        chosen = wp.array(rows, dtype=wp.int32, device=self.q.device)
        return Hands(
            wp.indexedarray(self.pose, [chosen]).contiguous(), wp.indexedarray(self.q, [chosen, None]).contiguous()
        )

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Base (N, 7) and joint positions (N, K)."""
        return to_numpy(self.pose).reshape(-1, 7), to_numpy(self.q)
