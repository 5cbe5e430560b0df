"""Forward kinematics of a hand in torch: batched, differentiable to any order, on any device and in any precision."""

from functools import partial

import numpy as np
import torch

from lgrasp.hand.tree import Tree


class BodyKinematics:
    """Poses of all bodies of a hand (body 0 = static base, body 1 + j = joint j of the tree) for whole postures.

    A joint's motion is written as constant + sin x * constant + (1 - cos x) * constant (revolute) or constant + x *
    constant (prismatic), and joints of one depth of the tree are composed together.
    """

    def __init__(self, tree: Tree, *, dtype: torch.dtype = torch.float32, device: str | torch.device = "cpu") -> None:
        joints = len(tree.joint_dof)
        parent = tree.body_parent[1:] - 1  # joint of each joint
        depth = np.array([len(tree.path(1 + j)) - 1 for j in range(joints)])
        order = np.argsort(depth, kind="stable")
        place = np.argsort(order)  # of joint j among the sorted ones
        put, index = (partial(torch.as_tensor, dtype=kind, device=device) for kind in (dtype, torch.int64))
        axis = tree.joint_axis.astype(float)
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        K = np.cross(np.eye(3), axis[:, None])  # rows e_i x a: [a]x
        R0, slides = tree.T_parent_joint[:, :3, :3], tree.joint_prismatic.astype(bool)[:, None, None]
        rest = np.concatenate([R0, tree.T_parent_joint[:, :3, 3:]], 2)  # (J, 3, 4)
        none = np.zeros((joints, 3, 1))
        turn = np.concatenate([np.where(slides, 0.0, R0 @ K), none], 2)
        bend = np.concatenate([np.where(slides, 0.0, R0 @ K @ K), none], 2)
        slide = np.concatenate([np.zeros((joints, 3, 3)), np.where(slides, R0 @ axis[..., None], 0.0)], 2)
        self._column = index(tree.joint_column[order])
        self._mult, self._offset = put(tree.joint_mult[order]), put(tree.joint_offset[order])
        self._rest, self._turn, self._bend = put(rest[order]), put(turn[order]), put(bend[order])
        self._slide = put(slide[order]) if slides.any() else None
        self._counts = np.bincount(depth).tolist()
        starts = np.cumsum([0, *self._counts])
        self._parents = [
            index(place[parent[order[a:b]]] - before)
            for before, a, b in zip(starts, starts[1:], starts[2:], strict=False)
        ]
        self._bodies = index(np.concatenate([[0], 1 + place]))
        self._base = put(np.eye(4)[:3])

    def __call__(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """R (N, B, 3, 3) and t (N, B, 3) [m] of the bodies in the base frame, for postures q (N, K) [rad or m]."""
        x = (q[:, self._column] * self._mult + self._offset)[..., None, None]  # (N, J, 1, 1)
        local = self._rest + torch.sin(x) * self._turn + (1 - torch.cos(x)) * self._bend
        if self._slide is not None:
            local = local + x * self._slide
        parts = local.split(self._counts, 1)
        levels = [parts[0]]
        for part, parent in zip(parts[1:], self._parents, strict=True):
            up = levels[-1].index_select(1, parent)
            moved = up[..., :3] @ part
            levels.append(torch.cat([moved[..., :3], moved[..., 3:] + up[..., 3:]], -1))
        base = self._base.expand(len(q), 1, 3, 4)
        T = torch.cat([base, *levels], 1).index_select(1, self._bodies)  # (N, B, 3, 4)
        return T[..., :3], T[..., 3]
