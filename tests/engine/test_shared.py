"""Hands with joints that move several fingers: every row has one of the listed values, and fingers agree on it."""

from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lgrasp.dataset.reader import read_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.run import run as generate
from lgrasp.field.params import FieldParams
from lgrasp.grasp.records import GraspRows
from lgrasp.hand.arrays import body_poses, upload_hand
from lgrasp.hand.drafting.import_urdf import import_urdf
from lgrasp.hand.find import find_hand
from lgrasp.hand.model import HandModel
from lgrasp.hand.urdf import read_urdf
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.shard_inputs import named_hand
from lgrasp.judge.run import judge

FIELD = FieldParams(records=8000, index="bvh")


@pytest.fixture
def cache(cache_root) -> Cache:
    return Cache(cache_root)


def test_rows_take_the_listed_values_and_are_valid(cache, tmp_path):
    name = "schunk_svh"
    pipeline = load_pipeline("swift").model_copy(update={"field": FIELD})
    outcome = generate(GenerateJob(hand=name, object="sphere", rows=24, pipeline=pipeline, out=tmp_path, cache=cache))
    assert outcome.rows == 24
    shard = read_shard(outcome.paths[0])
    names = list(shard.hand.joint_names)
    shared = find_hand(name).spec.shared
    columns = [names.index(joint) for joint in shared]
    listed = {tuple(np.float32(v) for v in values) for values in product(*shared.values())}
    for q in (shard.grasps.q, shard.grasps.q_pregrasp):
        taken = {tuple(row) for row in q[:, columns]}
        assert taken <= listed
        assert len(taken) >= min(4, len(listed))
    # the judge poses every link from the one joint vector: fingers that disagreed would miss their contacts
    assert judge(outcome.paths).valid.all()
    model = named_hand(cache, name)[1]
    wanted = pressed(model, shard.grasps, pipeline.bounds.squeeze_force / pipeline.bounds.squeeze_stiffness)
    assert np.ptp(wanted[:, columns] - shard.grasps.q[:, columns], axis=0).min() > 0.01
    np.testing.assert_allclose(shard.grasps.q_squeeze, wanted, atol=2e-4)


def pressed(model: HandModel, rows: GraspRows, share: float) -> np.ndarray:
    """q + J^T f: J by central differences, f the stored forces times ``share`` [N over N m/rad]; within limits."""
    hand, body = upload_hand(model, "cpu"), model.tree.link_body[rows.contact_links[:, 0]]  # (N, C)
    used, row = rows.contact_links[:, 0] >= 0, np.arange(len(rows))[:, None]
    turn, at = Rotation.from_quat(rows.object_pose[:, 0, 3:], scalar_first=True).as_matrix(), rows.object_pose[:, 0, :3]
    points = np.einsum("nij,ncj->nci", turn, rows.contact_points[:, 0]) + at[:, None]
    forces = np.where(used[..., None], np.einsum("nij,ncj->nci", turn, rows.contact_forces[:, 0]), 0.0)

    def frames(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        X = body_poses(hand, q).astype(float)[row, body]  # (N, C, 7)
        return X[..., :3], Rotation.from_quat(X[..., 3:].reshape(-1, 4)).as_matrix().reshape(*body.shape, 3, 3)

    origin, rotation = frames(rows.q)
    local = np.nan_to_num(np.einsum("ncji,ncj->nci", rotation, points - origin))
    q = rows.q.astype(float)
    for k in range(q.shape[1]):
        step = np.zeros_like(rows.q)
        step[:, k] = 1e-2
        (a, A), (b, B) = frames(rows.q - step), frames(rows.q + step)
        motion = b - a + np.einsum("ncij,ncj->nci", B - A, local)
        q[:, k] += share * (motion * forces).sum((1, 2)) / 2e-2
    return np.clip(q, model.tree.joint_lower, model.tree.joint_upper)


def test_couplings_of_the_known_hand_fill_gaps(tmp_path):
    """A copy of a URDF that lost its mimic tags is driven like the hand."""
    folder = find_hand("barrett").urdf
    text = "\n".join(line for line in folder.read_text().splitlines() if "<mimic" not in line)
    bare = tmp_path / "bare.urdf"
    bare.write_text(text)
    source = find_hand(str(bare))
    assert source.known == "barrett"
    assert "couplings" in source.note
    coupling = source.spec.mimic["finger_2_prox_joint"]
    assert (coupling.joint, coupling.multiplier) == ("finger_1_prox_joint", -1.0)
    assert len(source.spec.mimic) == 4
    made = import_urdf(bare, out=tmp_path / "made")
    assert any(line.startswith("couplings of finger_1_dist_joint, finger_2_prox") for line in made.decisions)
    mimic = {j.name: j.mimic for j in read_urdf(made.folder / "hand.urdf").joints if j.mimic}
    assert mimic == {n: (c.joint, c.multiplier, c.offset) for n, c in source.spec.mimic.items()}


def test_joints_that_only_the_rules_couple_are_in_the_shard(cache, tmp_path):
    """Whoever poses the URDF of the shard by its joints gets the hand that grasped."""
    text = "\n".join(line for line in find_hand("barrett").urdf.read_text().splitlines() if "<mimic" not in line)
    bare = tmp_path / "bare.urdf"
    bare.write_text(text)
    pipeline = load_pipeline("swift").model_copy(update={"field": FIELD})
    outcome = generate(
        GenerateJob(hand=str(bare), object="sphere", rows=8, pipeline=pipeline, out=tmp_path / "out", cache=cache)
    )
    assert outcome.rows == 8
    shard = read_shard(outcome.paths[0])
    names = list(shard.hand.joint_names)
    assert len(names) == len(set(names)) == 8
    assert names[:4] == [n for n in names if n not in find_hand(str(bare)).spec.mimic]
    q = shard.grasps.q
    for joint, coupling in find_hand(str(bare)).spec.mimic.items():
        wanted = coupling.multiplier * q[:, names.index(coupling.joint)] + coupling.offset
        np.testing.assert_allclose(q[:, names.index(joint)], wanted, atol=1e-6)
    assert judge(outcome.paths).valid.all()
