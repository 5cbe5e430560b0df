"""Random draws: within their ranges, the same for a row wherever it is, and what they do to verdicts."""

import json
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError
from scipy.spatial.transform import Rotation
from support.jaws import Jaws, mesh_record, shipped_hand
from support.judging import judge
from support.solids import no_cut

from lgrasp.errors import PhysicsError
from lgrasp.simulate.draws import Draw, draw_of, tune
from lgrasp.simulate.model import build_model
from lgrasp.simulate.protocol import PROTOCOLS, Draws, Protocol
from lgrasp.simulate.run import protocol_text
from lgrasp.simulate.scene import Scene, hand_of_record, scene_of
from lgrasp.simulate.solid import object_of_record

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")

RANDOM = PROTOCOLS["fc_random"]
STIFFNESS = 3.0 / RANDOM.lever**2  # [N/m] of a jaw, least
NUMBERS = ("friction", "torsion", "mass", "stiffness", "damping_ratio", "softness")


@pytest.fixture
def fc_random(engine):
    """The protocol with two draws in each simulator."""
    return drawing(count=2).by(engine)


def drawing(**draws) -> Protocol:
    return RANDOM.model_copy(update={"draws": Draws(**draws)})


def test_draws_fill_their_ranges():
    draws = RANDOM.draws
    drawn = [draw_of(draws, candidate, number, 2) for candidate in range(100) for number in range(draws.count)]
    for name in NUMBERS:
        low, high = getattr(draws, name)
        values = np.array([getattr(draw, name) for draw in drawn])
        assert ((values >= low) & (values <= high)).all(), name
        assert np.ptp(values) > 0.98 * (high - low), name
        assert values.mean() == pytest.approx(0.5 * (low + high), rel=0.1), name
    for name, most in (("shifts", draws.shift), ("turns", np.radians(draws.turn))):
        values = np.stack([getattr(draw, name) for draw in drawn]).reshape(-1, 3)
        far = np.linalg.norm(values, axis=1)
        assert 0.98 * most < far.max() <= most
        assert np.median(far) == pytest.approx(0.5 ** (1 / 3) * most, rel=0.03)  # half of a ball's volume
        assert np.abs(values.mean(0)).max() < 0.05 * most


def test_a_draw_is_a_function_of_seed_row_and_number():
    first = draw_of(Draws(), 7, 2, 1)
    assert first.friction == draw_of(Draws(count=3), 7, 2, 1).friction
    narrow = draw_of(Draws(mass=(0.1, 0.1), turn=0.0), 7, 2, 2)
    assert (narrow.friction, narrow.mass) == (first.friction, 0.1)  # ranges of others do not matter
    np.testing.assert_array_equal(narrow.shifts[:1], first.shifts)  # nor does a second object
    others = (draw_of(Draws(seed=1), 7, 2, 1), draw_of(Draws(), 8, 2, 1), draw_of(Draws(), 7, 3, 1))
    assert len({first.friction, *(draw.friction for draw in others)}) == 4


def test_an_object_turns_about_its_centre_of_mass():
    pose = np.array([[0.1, 0.2, 0.3, *Rotation.from_rotvec([0.3, 0.2, 0.1]).as_quat(scalar_first=True)]])
    shift, turn = np.array([[0.001, -0.002, 0.0]]), np.array([[0.0, 0.02, 0.01]])
    (placed,) = Draw(*[0.0] * 6, shift, turn).placed(pose)
    before, after = (Rotation.from_quat(p[3:], scalar_first=True) for p in (pose[0], placed))
    np.testing.assert_allclose(placed[:3], pose[0, :3] + shift[0])
    np.testing.assert_allclose((after * before.inv()).as_rotvec(), turn[0], atol=1e-12)


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_a_model_is_as_if_compiled_with_the_draw(name: str):
    """Every number of it, also after another draw."""
    record, _, tree = shipped_hand(name)
    cube = object_of_record(mesh_record("cube", trimesh.creation.box([0.03, 0.04, 0.05])))
    scene = Scene(hand_of_record(record, no_cut), (cube,))
    q = tree.listed_values(tree.joint_open[None])[0]
    model = build_model(scene, RANDOM, q)
    untouched, own = copy(model.mujoco), model.own()
    for number in (0, 1):
        draw = draw_of(RANDOM.draws, 3, number, 1)
        tune(own, model, draw)
    protocol = RANDOM.model_copy(update={"draws": None} | {name: getattr(draw, name) for name in NUMBERS[:-1]})
    compiled = copy(build_model(scene, protocol, q).mujoco)
    compiled.geom_solref[:, 0] = draw.softness
    assert own.mujoco.stat.meaninertia == pytest.approx(compiled.stat.meaninertia, rel=1e-12)
    for found, wanted in ((own.mujoco, compiled), (model.mujoco, untouched)):
        for name in dir(wanted):
            values = getattr(wanted, name) if not name.startswith("_") else None
            if isinstance(values, np.ndarray) and values.dtype.kind in "fiub":
                np.testing.assert_allclose(getattr(found, name), values, rtol=1e-12, atol=1e-15, err_msg=name)


def test_holds_in_all_or_some_draws(jaws: Jaws, fc_random):
    """Two jaws of N each bear 1 N if 2 mu N > 1: the weakest of the drawn drives and the least friction decide."""
    strong = judge(jaws.shard(2.0 / STIFFNESS), fc_random, all_directions=True)
    assert strong["holds"] == [True]
    assert strong["share"] == np.float32([1.0])
    assert (strong["directions"] == 1).all()
    assert strong["contact_at_q"] == 2  # at the row's own pose
    slippery = judge(
        jaws.shard(2.0 / STIFFNESS), fc_random.model_copy(update={"draws": Draws(count=2, friction=(0.0, 0.01))})
    )
    assert slippery["holds"] == [False]
    assert slippery["share"] == np.float32([0.0])


def test_share_counts_draws(jaws: Jaws):
    """1 N against stiffness k x 0.4 mm, friction 0.6: the draws above some stiffness hold."""
    squeeze = 1.0 / (2 * 0.6 * 6.5 / RANDOM.lever**2)
    fixed = {"friction": (0.6, 0.6), "torsion": (0.005, 0.005), "shift": 0.0, "turn": 0.0}
    protocol = drawing(count=8, **fixed)
    found = judge(jaws.shard(squeeze), protocol)
    drawn = [draw_of(protocol.draws, 0, number, 1).stiffness for number in range(8)]
    assert found["share"] == np.float32([np.mean(np.array(drawn) > 6.5)])
    assert 0 < found["share"] < 1
    assert found["holds"] == [False]


def test_rows_stand_alone(jaws: Jaws, fc_random):
    """Neither the number of threads nor the other rows nor their order decide a verdict."""
    shard = jaws.shard(count=2)
    depth = np.array([0.5, 2.0], "f4")[:, None] / np.float32(STIFFNESS)
    rows = Jaws.rows(shard, q_squeeze=shard.grasps.q - depth)
    one = judge(shard, fc_random, rows=rows, threads=1)
    assert 0 < one["share"].mean() < 1
    turned = replace(rows, **{name: values[::-1] for name, values in rows.columns().items()})
    back = judge(shard, fc_random, rows=turned, threads=2)
    for name, values in one.items():
        np.testing.assert_array_equal(values, back[name][::-1], err_msg=name)


def test_stored_text_says_the_seed_and_what_is_not_used(jaws: Jaws, fc_random):
    shard = jaws.shard()
    text = json.loads(protocol_text(scene_of(shard.hand, shard.objects), fc_random))
    assert text["draws"] == fc_random.draws.model_dump(mode="json")
    assert text["draws"]["seed"] == 0
    assert text["objects"][0].keys().isdisjoint({"mass", "stiffness"})
    assert Protocol.model_validate({name: text[name] for name in Protocol.model_fields}) == fc_random
    if fc_random.engine != "mujoco":
        assert {"softness", "torsion"} < set(text["solver"]["not_used"])


def test_bad_input(jaws: Jaws):
    for wrong in ({"mass": (0.2, 0.1)}, {"mass": (0.0, 0.1)}, {"friction": (-0.1, 0.1)}, {"count": 0}):
        with pytest.raises(ValidationError):
            Draws(**wrong)
    with pytest.raises(ValidationError, match="kind must be force"):
        Protocol(name="heavy", kind="weight", draws=Draws())
    with pytest.raises(PhysicsError, match="fc_random has random draws, which run on the CPU alone"):
        judge(jaws.shard(), RANDOM, device="cuda:0")
