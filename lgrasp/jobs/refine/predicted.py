"""A planner whose hands start where networks draw them."""

from concurrent.futures import ThreadPoolExecutor

from lgrasp.hand.arrays import HandArrays
from lgrasp.hand.contact_surface import ContactSurface
from lgrasp.learn.grasp.completion import LIKELY, SHARES
from lgrasp.learn.grasp.file import Networks
from lgrasp.learn.grasp.predictor import GraspPredictor
from lgrasp.object.model import ObjectModel
from lgrasp.planning.params import PlanParams
from lgrasp.planning.planner import Guesses, Planner


def predicted_planner(
    networks: Networks,
    hand: HandArrays,
    model: ObjectModel,
    starts: int,
    params: PlanParams,
    palmar: ContactSurface | None,
    around: ObjectModel | None = None,
    *,
    seed: int = 0,
) -> Planner:
    """The planner of an object or of the model of a cloud, whose unseen sides are guessed.

    Args:
        starts: how many there will be at most.
        palmar, around: as of :class:`Planner`.
    """
    predictor = GraspPredictor(hand.model.tree, networks, model.contact_points, model.contact_normals, hand.device)
    unsure = predictor.one_sided and not len(model.faces)
    draws = params.effort(hand.model.groups, unsure).draws
    _ = predictor.grids  # both threads need them
    surfaces = range(len(SHARES)) if unsure else [LIKELY]  # the widest first: hands stop outside, fingers close
    with ThreadPoolExecutor(1) as pool:
        drawn = pool.submit(predictor.draw, starts * draws, seed)
        whole, *others = [model] if len(model.faces) else [predictor.completed(model, k) for k in surfaces]
    return Planner(hand, whole, 0.0, params, palmar, around, Guesses(*drawn.result()), tuple(others))
