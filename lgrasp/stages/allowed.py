"""Where a hand may touch in a job, link by link, on its device."""

import numpy as np

from lgrasp.grasp.contact_kernels import PalmarRuns
from lgrasp.grasp.find_contacts import palmar_runs
from lgrasp.hand.contact_surface import ContactSurface, contact_surface
from lgrasp.stages.context import Context


def allowed_runs(context: Context) -> PalmarRuns:
    """The contact surface of a hand as far as a steering lets it touch; made once for a job."""

    def make() -> PalmarRuns:
        at = np.flatnonzero(context.steered.touching.points)
        side = contact_surface(context.hand.model)
        return palmar_runs(context.hand, ContactSurface(*(values[at] for values in side)), at)

    return context.once("allowed", make, context.steered)
