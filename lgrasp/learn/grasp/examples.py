"""What the one-object predictor learns from: grasps as steps of a hand that holds nothing, and views of objects."""

import torch

from lgrasp.hand.tree import Tree
from lgrasp.learn.diffuser.examples import SequenceSteps, Sights, StepExamples
from lgrasp.learn.diffuser.network import DiffuserNet
from lgrasp.learn.grasp.completion import LIKELY, CompletionNet, completed_grids
from lgrasp.learn.grasp.completion_training import ViewSet
from lgrasp.learn.grasp.params import GraspParams


def first_steps(tree: Tree, R: torch.Tensor, t: torch.Tensor, q: torch.Tensor, number: torch.Tensor) -> SequenceSteps:
    """Grasps as steps of a hand that holds nothing, every joint free.

    Args:
        R, t, q: pose of the centred object in the hand frame, (E, 3, 3), (E, 3), and joints (E, K).
        number: of the object, (E,).
    """
    n, none = len(q), torch.zeros(q.shape, dtype=torch.bool)
    return SequenceSteps(
        R=R,
        t=t,
        q=q,
        start=torch.as_tensor(tree.joint_open, dtype=torch.float32).expand(n, -1),
        used=none,
        free=~none,
        space=torch.zeros(n, dtype=torch.int64),
        object=number,
        held=torch.full((n, 1), -1),
        held_rotation=torch.eye(3).expand(n, 1, 3, 3),
        held_position=torch.zeros(n, 1, 3),
    )


def grasp_examples(
    tree: Tree, steps: SequenceSteps, views: ViewSet, net: DiffuserNet, completion: CompletionNet, p: GraspParams
) -> StepExamples:
    """Grasps with views of their objects; hands feel the distances of the object as it is completed from a view."""
    device = views.points.device
    grids = [surfaces[LIKELY] for surfaces in completed_grids(completion, views.points, views.normals, p.nodes)]
    sights = Sights(views.R, views.t)
    return StepExamples(tree, steps, views.points, grids, net, p, device, sights=sights, each=views.each)
