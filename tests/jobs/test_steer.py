"""Grasps that obey what is asked of them, told from the rows alone."""

import json
from typing import Any

import h5py
import numpy as np
import pytest
from support.rows_touching import touching

from lgrasp.config import parse_model
from lgrasp.dataset.reader import read_shard
from lgrasp.engine.batch import run_stages
from lgrasp.engine.run import run as generate
from lgrasp.engine.run import run as run_job
from lgrasp.engine.shard import shard_context
from lgrasp.errors import ConfigError, ShardError
from lgrasp.geometry.poses import device_matrix, pose_matrix
from lgrasp.hand.find import find_hand
from lgrasp.jobs.config import JobConfig, plan_requests
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.simulate import SimulateJob
from lgrasp.judge.run import judge

FINGERS = find_hand("allegro").spec.fingers


@pytest.mark.parametrize("asked", ["thumb,index,middle", ("thumb", "link_7.0_tip")])
def test_exactly_these_fingers_touch(steered, asked):
    shard, _ = steered(rows=16, fingers=asked)
    named = asked.split(",") if isinstance(asked, str) else asked
    wanted = {name if name in FINGERS else next(f for f, links in FINGERS.items() if name in links) for name in named}
    for links in touching(shard):
        assert {f for f, own in FINGERS.items() if links & set(own)} == wanted
        assert links <= {"base_link", *(link for f in wanted for link in FINGERS[f])}
    assert shard.header.config["pipeline"]["steer"]["fingers"] == list(named)


def test_a_lateral_grasp_touches_with_the_side_of_the_index_finger(steered, link_poses):
    """Its radial side looks along y of its links, and the thumb's tip presses against it; the judge finds another."""
    shard, path = steered(grasp_type="lateral", rows=6)
    rows, names = shard.grasps, np.array(shard.hand.link_names)
    assert all(
        "link_15.0_tip" in links and links & {"link_2.0", "link_3.0", "link_3.0_tip"} and len(links) == 2
        for links in touching(shard)
    )
    T = pose_matrix(rows.object_pose[:, 0].astype(float))
    row, at = np.nonzero(~np.isin(rows.contact_links[:, 0], [-1, list(names).index("link_15.0_tip")]))
    inward = -np.einsum("nij,nj->ni", T[row, :3, :3], rows.contact_normals[row, 0, at])
    link = link_poses(rows.q)[row, rows.contact_links[row, 0, at]]
    assert (np.einsum("nji,nj->ni", link[:, :3, :3], inward)[:, 1] > np.cos(np.radians(40 + 15))).all()
    assert judge(path).valid_share == 1.0
    config = shard.header.config
    sides = [side | {"axis": [0, -1, 0]} for side in config["steered"]["sides"]]
    ask_otherwise(path, config, sides=sides)
    assert judge(path).failed["steered"].all()


def ask_otherwise(path, config, **changes):
    """Rewrite what a shard says was asked, as its author."""
    with h5py.File(path, "r+") as file:
        file.attrs["config"] = json.dumps(config | {"steered": config["steered"] | changes})
        file.attrs.pop("text_sha256", None)


def thumb_angles(shard, link_poses):
    """Between the plane that Allegro's thumb bends in, across y of its last links, and the palm's, across x [deg]."""
    thumb = list(shard.hand.link_names).index("link_15.0_tip")
    return np.degrees(np.arccos(np.minimum(np.abs(link_poses(shard.grasps.q)[:, thumb, 0, 1]), 1.0)))


@pytest.mark.parametrize("asked", [{"thumb": "adducted"}, {"grasp_type": "adduction-grip"}])
def test_the_thumb_is_where_it_is_asked_to_be(steered, link_poses, asked):
    """Also where it does not touch, as in an adduction grip; the judge agrees, and finds rows with another thumb."""
    shard, path = steered(rows=6, **asked)
    angles, adducted = thumb_angles(shard, link_poses), asked.get("thumb") == "adducted"
    middle = shard.header.config["steered"]["thumb"]["angle"]
    assert 45 < middle < 55  # its range is 15 to 86
    assert (angles < middle + 0.01).all() if adducted else (angles > middle - 0.01).all()
    if "grasp_type" in asked:
        assert not any("link_15.0_tip" in links for links in touching(shard))
    assert judge(path).valid_share == 1.0
    config = shard.header.config
    for change in ({"place": "abducted" if adducted else "adducted"}, {"link": "thumb"}):
        thumb = config["steered"]["thumb"] | change
        ask_otherwise(path, config, thumb=thumb)
        assert judge(path).failed["steered"].all()


def test_a_type_that_the_hand_cannot_make(job, swift):
    with pytest.raises(ConfigError, match="grasp type precision-disk: hand 'allegro' has no little finger"):
        job(pipeline=swift.with_steering(grasp_type="precision-disk"))


def test_fingers_of_the_published_index(lightning, load):
    """Contacts of the boxes obey as those of the voxels do."""
    pipeline = lightning.with_steering(fingers="index,thumb")
    inputs = load(pipeline=pipeline)
    sets = run_stages(pipeline, shard_context(pipeline, inputs, 0), 0, 500, "search").arrays()
    assert len(sets["chosen"]) > 0
    tree = inputs.hand.model.tree
    groups = [tree.group_of(FINGERS[name][-1]) for name in ("index", "thumb")]
    np.testing.assert_array_equal(sets["chosen"] >= 0, np.isin(range(4), groups)[None].repeat(len(sets["chosen"]), 0))


def test_only_these_links_touch(steered):
    allowed = ["link_3.0_tip", "link_7.0_tip", "link_15.0_tip"]
    assert set().union(*touching(steered(rows=16, links=allowed)[0])) == set(allowed)


@pytest.mark.parametrize("palm", ["no", "must"])
def test_the_palm_touches_as_asked(steered, palm):
    touches = ["base_link" in links for links in touching(steered(palm=palm, rows=12)[0])]
    assert all(touches) if palm == "must" else not any(touches)


@pytest.mark.parametrize(("approach", "sources"), [("1,2,0:8", {}), ("0,1,0:15", {"palm": "must"})])
def test_the_palm_faces_into_the_cone(steered, approach, sources):
    """Also where the object is pressed on the palm; Allegro's palm faces along x of its base."""
    rows = steered(rows=12, approach=approach, **sources)[0].grasps
    faces = pose_matrix(rows.object_pose[:, 0].astype(float))[:, 0, :3]
    direction, _, angle = approach.partition(":")
    middle = np.array(direction.split(","), float)
    assert (faces @ middle / np.linalg.norm(middle) >= np.cos(np.radians(float(angle))) - 1e-3).all()


def test_every_source_of_poses_stays_in_the_cone(swift, load):
    for name in ("canonical", "exhaustive", "pinch", "palm"):
        weights = dict.fromkeys(("canonical", "exhaustive", "pinch", "palm"), 0.0) | {name: 1.0}
        pipeline = swift.with_params("place", samples=0, **weights).with_steering(approach="0,-2,0:20")
        inputs = load(pipeline=pipeline)
        poses = run_stages(pipeline, shard_context(pipeline, inputs, 0), 0, 2000, "place").arrays()["pose"]
        faces = device_matrix(poses)[:, 0, :3]
        assert len(poses) > 20, name
        assert (faces[:, 1] <= -np.cos(np.radians(20.0)) + 1e-5).all()
        assert np.ptp(np.arctan2(faces[:, 2], faces[:, 0])) > 5  # all around


def test_the_hand_stays_above_the_plane(steered, solids, link_poses):
    rows = steered(above="0,0.6,0.8,0.01", rows=12)[0].grasps
    T = pose_matrix(rows.object_pose[:, 0].astype(float))
    for q in (rows.q, rows.q_pregrasp):
        links = np.linalg.inv(T)[:, None] @ link_poses(q)
        for solid in solids.solids:
            L = links[:, solid.link]
            points = np.einsum("nij,pj->npi", L[:, :3, :3], solid.samples) + L[:, None, :3, 3]
            assert (points @ [0, 0.6, 0.8]).min() > 0.0109


def test_the_judge_agrees_and_finds_rows_that_do_not_obey(steered):
    _, path = steered(rows=4, fingers="thumb,index,middle", palm="no", approach="1,0,0:40", above="0,0,1,0.001")
    assert judge(path).valid_share == 1.0
    with h5py.File(path) as file:
        config = json.loads(file.attrs["config"])
    assert config["steered"]["every"] == [["link_3.0_tip"], ["link_7.0_tip"], ["link_15.0_tip"]]
    for name, value in (
        ("links", ["link_3.0_tip", "link_7.0_tip"]),
        ("every", [["link_11.0_tip"]]),
        ("approach", {"direction": [-1, 0, 0], "angle": 40}),
        ("above", [0, 0, 1, 0.003]),
    ):
        ask_otherwise(path, config, **{name: value})
        report = judge(path)
        assert report.failed["steered"].all(), name
        assert not any(mask.any() for check, mask in report.failed.items() if check != "steered"), name


@pytest.fixture(scope="module")
def unsteered(small_job, tmp_path_factory):
    """A shard of grasps of which nothing is asked."""
    (path,) = generate(GenerateJob(**small_job | {"rows": 20, "out": tmp_path_factory.mktemp("unsteered")})).paths
    return path


@pytest.mark.parametrize("kind", [".csv", ".h5"])
def test_the_object_is_where_the_file_says(steered, unsteered, tmp_path, kind):
    given = unsteered
    poses = np.unique(read_shard(given).grasps.object_pose[:, 0].astype(float), axis=0)  # some have several rows
    if kind == ".csv":
        given = tmp_path / "poses.csv"
        np.savetxt(given, poses, delimiter=",", header="x,y,z,qw,qx,qy,qz", comments="")
    shard, path = steered(pose=given)
    found = shard.grasps.object_pose[:, 0]
    assert np.abs(found[:, None] - poses[None]).max(2).min(1).max() < 1e-5
    assert len(np.unique(found.round(4), axis=0)) > 1
    if kind == ".csv":
        obeys_only_its_poses(path)


def obeys_only_its_poses(path):
    """The judge agrees, and finds the rows of a pose that was not asked for."""
    assert judge(path).valid_share == 1.0
    shard = read_shard(path)
    config, found = dict(shard.header.config), shard.grasps.object_pose[:, 0].astype(float)
    poses = np.array(config["steered"]["poses"])
    mine = np.abs(found[:, None] - poses[None]).max(2).argmin(1) == (gone := np.abs(poses - found[0]).max(1).argmin())
    others = np.delete(poses, gone, 0).tolist()
    ask_otherwise(path, config, poses=others)
    np.testing.assert_array_equal(judge(path).failed["steered"], mine)


def test_poses_of_the_hand(steered, unsteered, tmp_path):
    T = pose_matrix(read_shard(unsteered).grasps.object_pose[:, 0].astype(float))
    np.savez(tmp_path / "hand.npz", T_object_hand=np.linalg.inv(T))
    found = pose_matrix(steered(pose=tmp_path / "hand.npz", rows=5)[0].grasps.object_pose[:, 0].astype(float))
    assert np.abs(found[:, None] - T[None]).max((2, 3)).min(1).max() < 1e-5


def test_a_steering_without_poses_ends_early(job, swift, tmp_path, monkeypatch):
    """At the same candidate with other batches, and with the line that says why; the plane is above all of it."""
    monkeypatch.setattr("lgrasp.engine.shard._LEAST_PLACED", 1024)
    for batch in (100, 512):
        hopeless = job(pipeline=swift.with_steering(above="0,0,1,0.5"), rows=20, batch=batch, out=tmp_path / str(batch))
        outcome = generate(hopeless)
        assert outcome.results[0].candidates == 1024
        assert "at none of 1,024 poses" in str(hopeless.shortfall(outcome))


def test_a_plane_is_no_table_to_lift_from(steered, job, swift, tmp_path):
    _, path = steered(rows=2, above="0,0,1,0.001")
    given = {"shards": (path.parent,), "protocol": "lift", "out": tmp_path / "lifted"}
    with pytest.raises(ShardError, match=r"allegro-mug-00000\.h5: the plane of --above .* generate --table"):
        run_job(parse_model(SimulateJob, given, "simulate"))
    lifted = swift.with_simulation("lift")
    with pytest.raises(ConfigError, match="stage simulate: the plane of --above"):
        job(pipeline=lifted.with_steering(above="0,0,1,0.001")).check()


def test_poses_out_of_reach_are_told(job, swift, tmp_path):
    """After few turns of each."""
    np.save(tmp_path / "far.npy", [[0.0, 0.0, 3.0, 1.0, 0.0, 0.0, 0.0]])
    far = job(pipeline=swift.with_steering(pose=tmp_path / "far.npy"), rows=20)
    outcome = generate(far)
    error = far.shortfall(outcome)
    assert outcome.results[0].candidates == 1024
    assert isinstance(error, ConfigError)
    assert "at none of 1 pose of the file" in str(error)


def test_a_config_steers_every_pipeline():
    names = {"objects": ["mug", "box"], "pipelines": ["swift", "robust"]}
    config = parse_model(JobConfig, names | {"steer": {"fingers": "thumb,index"}}, "config")
    requests: list[Any] = plan_requests(config)
    assert {request.pipeline.steer.fingers for request in requests} == {("thumb", "index")}
    assert len({request.out for request in requests}) == 4
    assert all("-steer-" in request.out.name for request in requests)


@pytest.mark.parametrize("values", [np.zeros((0, 7)), np.zeros((3, 4, 4)), np.ones((2, 7)), np.ones((2, 5))])
def test_files_without_poses_are_told(run, swift, tmp_path, values):
    np.save(tmp_path / "poses.npy", values)
    with pytest.raises(ConfigError, match=r"steer.pose: .*poses.npy"):
        run(pipeline=swift.with_steering(pose=tmp_path / "poses.npy"))


def test_other_poses_are_other_grasps(job, swift, tmp_path):
    """The content of the file counts, not its name."""
    pose = np.array([[0.1, 0, 0, 1, 0, 0, 0.0]])
    keys = []
    for name, values in (("a", pose), ("b", pose), ("c", -pose)):
        np.save(tmp_path / f"{name}.npy", values)
        keys.append(job(pipeline=swift.with_steering(pose=tmp_path / f"{name}.npy")).key())
    assert keys[0] == keys[1] != keys[2]


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"fingers": "thump"}, "did you mean 'thumb'.*index, middle, ring, thumb"),
        ({"fingers": "thumb,link_15.0_tip"}, "thumb and link_15.0_tip .* are one"),
        ({"fingers": "base_link"}, "no finger 'base_link'"),
        ({"links": "link_3.0"}, "no contact surface on 'link_3.0'.*contact links: base_link, link_3.0_tip"),
        ({"links": "link_3.0_tip", "fingers": "thumb"}, "none is on finger 'thumb'"),
        ({"links": "base_link"}, "only 0 of its fingers, and the palm"),
        ({"fingers": "thumb", "palm": "no"}, "only 1 of its fingers, and no palm"),
        ({"links": "link_3.0_tip,link_15.0_tip", "palm": "must"}, "no palm surface that may touch"),
        ({"palm": "maybe"}, "'yes', 'no' or 'must'"),
        ({"thumb": "adducting"}, "'abducted' or 'adducted'"),
        ({"approach": "0,0,0:30"}, "must not be zero"),
        ({"approach": "0,0:30"}, "give 3 numbers"),
        ({"approach": "0,0,1:300"}, "less than or equal to 180"),
        ({"above": "0,0,0,1"}, "the normal must not be zero"),
        ({"pose": "nowhere.npz"}, "no such file"),
        ({"pose": __file__, "approach": "0,0,1"}, "leave out approach"),
    ],
)
def test_what_leaves_nothing_is_told(run, swift, asked, words):
    with pytest.raises(ConfigError, match=words):
        run(pipeline=swift.with_steering(**asked))


def test_too_many_contacts_for_the_links_are_told(run, swift):
    asked = swift.with_params("search", contacts=(4,)).with_steering(links="link_3.0_tip,link_15.0_tip")
    with pytest.raises(ConfigError, match=r"leaves 2 fingers .* asks for 4 or more"):
        run(pipeline=asked)


def test_steered_and_unsteered_do_not_mix(job, swift):
    steered = [swift.with_steering(fingers=names) for names in ("thumb,index", "thumb,middle")]
    assert len({job(pipeline=pipeline).key() for pipeline in (swift, *steered)}) == 3
    assert swift.with_steering().describe() == swift.describe()
    assert "steer" not in json.dumps(swift.describe())
    assert steered[0] == swift.with_settings(["steer.fingers=[thumb, index]"])
