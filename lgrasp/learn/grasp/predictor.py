"""Grasps of an object of which a cloud is known, as two trained networks guess them."""

from functools import cached_property

import numpy as np
import torch

from lgrasp.cloud.model import completed_object
from lgrasp.grasp.sequences import HeldHands
from lgrasp.hand.tree import Tree
from lgrasp.learn.diffuser.sampler import DrawnSteps, StepSampler
from lgrasp.learn.grasp.completion import LIKELY, ONE_SIDED, completed_grids
from lgrasp.learn.grasp.file import Networks
from lgrasp.learn.grasp.views import make_view
from lgrasp.object.model import ObjectModel
from lgrasp.object.sdf import SdfGrid, sample_sdf


class CloudCompletion:
    """Networks with one cloud before them: the whole object. What they guess turns and moves with the cloud.

    Args:
        points: of the cloud [m], (n, 3). normals: outward, (n, 3).
    """

    def __init__(self, networks: Networks, points: np.ndarray, normals: np.ndarray, device: str = "cpu") -> None:
        self._networks, self._device = networks, device
        self.view = make_view(points, normals, networks.params.cloud)

    @cached_property
    def grids(self) -> tuple[SdfGrid, ...]:
        """Signed distances from the surfaces SHARES of the whole object, in the frame of the view."""
        points, normals = (torch.as_tensor(x, device=self._device)[None] for x in (self.view.points, self.view.normals))
        completes, nodes = self._networks.completes.to(self._device), self._networks.params.nodes
        return completed_grids(completes, points, normals, nodes)[0]

    def distance(self, places: np.ndarray, surface: int = LIKELY) -> np.ndarray:
        """Signed distances [m] from a surface of SHARES that is guessed, of places (n, 3) in the cloud's frame, (n,);
        positive beyond what is guessed."""
        grid, local = self.grids[surface], (places - self.view.t) @ self.view.R
        beyond = np.linalg.norm(np.maximum(np.abs(local) + float(grid.origin[0]), 0), axis=1)
        found = sample_sdf(grid, local)
        return np.where(beyond > 0, np.maximum(found, 0) + beyond, found)

    @property
    def one_sided(self) -> bool:
        """Whether the cloud shows one side."""
        return float(np.linalg.norm(self.view.normals.mean(0))) > ONE_SIDED

    def completed(self, model: ObjectModel, surface: int = LIKELY) -> ObjectModel:
        """The model of the cloud, whose internal frame is the cloud's frame here, with the sides that nobody saw as a
        surface of SHARES."""
        grid = self.grids[surface]
        inside = (np.argwhere(grid.values < 0) * grid.cell + grid.origin) @ self.view.R.T + self.view.t
        return completed_object(model, lambda x: self.distance(x, surface), inside)


class GraspPredictor(CloudCompletion):
    """The same, and grasps of the object.

    Args:
        tree: of the hand. Others: as of :class:`CloudCompletion`.
    """

    def __init__(
        self, tree: Tree, networks: Networks, points: np.ndarray, normals: np.ndarray, device: str = "cpu"
    ) -> None:
        super().__init__(networks, points, normals, device)
        self._tree = tree

    def draw(self, count: int, seed: int = 0, *, steps: int = 10) -> DrawnSteps:
        """``count`` grasps; poses are those of the cloud's frame in the hand's. A function of its arguments."""
        tree = self._tree
        hands = HeldHands(
            tree.joint_open[None].astype(np.float32),
            np.zeros((1, len(tree.joint_open)), bool),
            np.zeros((1, 0, 7), np.float32),
        )
        return self._sampler.draw(
            hands, np.zeros(1, int), ~hands.used, each=count, seed=seed, steps=steps, view=(self.view.R, self.view.t)
        )

    @cached_property
    def _sampler(self) -> StepSampler:
        draws, process = self._networks.draws, self._networks.params.process
        return StepSampler(self._tree, draws, process, [self.view.points], [self.grids[LIKELY]], self._device)
