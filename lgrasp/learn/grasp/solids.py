"""Views of random solids, from which completing is learnt."""

from collections.abc import Generator, Mapping, Sequence
from functools import partial
from typing import NamedTuple, get_args

import numpy as np

from lgrasp.choices import ShapeKind
from lgrasp.learn.diffuser.features import mesh_centre
from lgrasp.learn.diffuser.senses import coarse_grid
from lgrasp.learn.grasp.views import CloudView, draw_views
from lgrasp.object.sdf import SdfGrid
from lgrasp.object.shapes import deformed_shape, random_shape
from lgrasp.runtime.cores import cores
from lgrasp.runtime.processes import ProcessPool, none_killed

VIEWS = 6
"""Of each solid."""

_DEFORMED = 0.4  # share of the solids
_A_PROCESS = 16  # solids at least, which take as long as its start


class SeenSolid(NamedTuple):
    """What is known of one solid."""

    views: list[CloudView]
    grid: SdfGrid


def random_solid(seed: int, number: int, points: int) -> SeenSolid:
    """Every second one is of a kind of household things, in turn, the others of free forms; most are deformed. Each
    view has so many points."""
    rng, kinds = np.random.default_rng([seed, number]), get_args(ShapeKind)
    mesh = random_shape(seed, number, kinds[number // 2 % len(kinds)] if number % 2 else None)
    if rng.random() < _DEFORMED:
        mesh = deformed_shape(mesh, rng)
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    views = draw_views(vertices - mesh_centre(vertices), faces, VIEWS, points, rng)
    return SeenSolid(views, coarse_grid(vertices, faces, closed=True))


def random_solids(seed: int, numbers: Sequence[int], points: int) -> Generator[SeenSolid]:
    """Those of some numbers, by as many processes as there are cores; few are made here."""
    make, count = partial(random_solid, seed, points=points), len(numbers)
    if count < _A_PROCESS:
        yield from map(make, numbers)
        return
    with none_killed("makes solids"), ProcessPool(min(cores(), count // _A_PROCESS)) as pool:
        for future in [pool.submit(make, number) for number in numbers]:
            yield future.result()


def solid_arrays(solids: Sequence[SeenSolid]) -> dict[str, np.ndarray]:
    """Some solids with equally many views, to be kept."""
    arrays = {name: np.stack([[getattr(v, name) for v in one.views] for one in solids]) for name in CloudView._fields}
    grids = [one.grid for one in solids]
    return arrays | {
        "values": np.concatenate([grid.values.ravel() for grid in grids]),
        "shape": np.array([grid.values.shape for grid in grids]),
        "origin": np.stack([grid.origin for grid in grids]),
        "cell": np.array([grid.cell for grid in grids]),
    }


def solids_of(arrays: Mapping[str, np.ndarray]) -> list[SeenSolid]:
    """Those of :func:`solid_arrays`."""
    ends = np.cumsum(arrays["shape"].prod(1))
    values = [v.reshape(n) for v, n in zip(np.split(arrays["values"], ends[:-1]), arrays["shape"], strict=True)]
    grids = map(SdfGrid, values, arrays["origin"], arrays["cell"].tolist())
    views = zip(*(arrays[name] for name in CloudView._fields), strict=True)
    return [SeenSolid(list(map(CloudView, *own)), grid) for own, grid in zip(views, grids, strict=True)]
