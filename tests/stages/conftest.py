"""Tables of one small batch, and the same hand and object as an independent reader sees them."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from lgrasp.engine.batch import run_stages

CANDIDATES = 2000


@pytest.fixture(scope="session")
def tables(swift, context) -> SimpleNamespace:
    """Outputs of the stages of the default pipeline for candidates 0 .. 1999."""
    return SimpleNamespace(**{s: run_stages(swift, context, 0, CANDIDATES, s) for s in swift.order})


@pytest.fixture(scope="session")
def solids(inputs):
    """The hand as the reference judge reads it from the URDF."""
    judge = pytest.importorskip("reference.judge")

    def no_meshes(name):
        raise AssertionError(f"the shipped hand has no meshes, asked for {name}")

    model = inputs.hand.model
    hand = judge.Hand(model.urdf_text, no_meshes, model.tree.base_link)
    assert tuple(hand.links) == tuple(model.tree.link_names)
    return hand


@pytest.fixture(scope="session")
def mesh(inputs) -> trimesh.Trimesh:
    """The object in its internal frame."""
    model = inputs.object.model
    return trimesh.Trimesh(model.vertices - model.center, model.faces, process=False)


@pytest.fixture(scope="session")
def link_poses(inputs, solids) -> Callable[[np.ndarray], np.ndarray]:
    """Joint positions (n, K) -> poses of the links in the base frame (n, L, 4, 4)."""

    def poses(q: np.ndarray) -> np.ndarray:
        names = inputs.hand.model.tree.joint_names
        values = {name: np.asarray(q[:, i], float) for i, name in enumerate(names)}
        return solids.forward(solids.resolve_joints(values, len(q)), len(q))

    return poses


@pytest.fixture(scope="session")
def finger_posture(inputs) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Groups (n,) and their joints (n, MAX_DOFS) -> whole postures (n, K), other joints at 0."""

    def posture(group: np.ndarray, q: np.ndarray) -> np.ndarray:
        tree = inputs.hand.model.tree
        out = np.zeros((len(group), len(tree.joint_names)))
        for g in range(tree.groups):
            rows = np.flatnonzero(group == g)
            columns = tree.dof_index[tree.dof_first[g] : tree.dof_first[g + 1]]
            out[np.ix_(rows, columns)] = q[rows, : len(columns)]
        return out

    return posture


@pytest.fixture(scope="session")
def link_distance(solids) -> Callable[[int, np.ndarray], np.ndarray]:
    """Signed distance [m] of points (n, 3) in the frame of a link to the link's solids."""

    def distance(link: int, points: np.ndarray) -> np.ndarray:
        return np.min([s.signed(points) for s in solids.solids if s.link == link], axis=0)

    return distance


@pytest.fixture(scope="session")
def pose_matrices() -> Callable[[np.ndarray], np.ndarray]:
    """(n, 7) x y z, qx qy qz qw -> (n, 4, 4)."""

    def matrices(pose: np.ndarray) -> np.ndarray:
        T = np.tile(np.eye(4), (len(pose), 1, 1))
        T[:, :3, :3] = Rotation.from_quat(pose[:, 3:]).as_matrix()
        T[:, :3, 3] = pose[:, :3]
        return T

    return matrices
