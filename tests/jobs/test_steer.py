"""Grasps that obey what is asked of them, told from the rows alone."""

import json

import numpy as np
import pytest

from lgrasp.dataset.reader import read_shard
from lgrasp.engine.batch import run_stages
from lgrasp.engine.shard import shard_context
from lgrasp.errors import ConfigError
from lgrasp.hand.find import find_hand

FINGERS = find_hand("allegro").spec.fingers


@pytest.fixture
def steered(run, swift, tmp_path):
    """steered(**asked): a small shard of grasps of the mug that are steered so."""

    def steered(pipeline=swift, rows=30, **asked):
        outcome = run(pipeline=pipeline.with_steering(**asked), rows=rows, shard_rows=rows, out=tmp_path / "steered")
        (path,) = outcome.paths
        shard = read_shard(path)
        assert len(shard.grasps) == rows
        return shard

    return steered


def touching(shard):
    """Names of the links that touch, row by row."""
    names = np.array(shard.hand.link_names)
    return [set(names[row[row >= 0]]) for row in shard.grasps.contact_links.reshape(len(shard.grasps), -1)]


@pytest.mark.parametrize("asked", ["thumb,index,middle", ("thumb", "link_7.0_tip")])
def test_exactly_these_fingers_touch(steered, asked):
    shard = steered(fingers=asked)
    named = asked.split(",") if isinstance(asked, str) else asked
    wanted = {name if name in FINGERS else next(f for f, links in FINGERS.items() if name in links) for name in named}
    for links in touching(shard):
        assert {f for f, own in FINGERS.items() if links & set(own)} == wanted
        assert links <= {"base_link", *(link for f in wanted for link in FINGERS[f])}
    assert shard.header.config["pipeline"]["steer"]["fingers"] == list(named)


def test_fingers_of_the_published_index(lightning, load):
    """Contacts of the boxes obey as those of the voxels do."""
    pipeline = lightning.with_steering(fingers="index,thumb")
    inputs = load(pipeline=pipeline)
    sets = run_stages(pipeline, shard_context(pipeline, inputs, 0), 0, 2000, "search").arrays()
    assert len(sets["chosen"]) > 0
    tree = inputs.hand.model.tree
    groups = [tree.group_of(FINGERS[name][-1]) for name in ("index", "thumb")]
    np.testing.assert_array_equal(sets["chosen"] >= 0, np.isin(range(4), groups)[None].repeat(len(sets["chosen"]), 0))


def test_only_these_links_touch(steered):
    allowed = ["link_3.0_tip", "link_7.0_tip", "link_15.0_tip"]
    assert set().union(*touching(steered(links=allowed))) == set(allowed)


@pytest.mark.parametrize("palm", ["no", "must"])
def test_the_palm_touches_as_asked(steered, palm):
    touches = ["base_link" in links for links in touching(steered(palm=palm, rows=12))]
    assert all(touches) if palm == "must" else not any(touches)


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
