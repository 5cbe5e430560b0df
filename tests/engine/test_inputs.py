"""Objects of jobs: what is wrong with a mesh is told whenever a job uses it, cached or not."""

import trimesh

from lgrasp.engine.cache import Cache
from lgrasp.engine.inputs import Loader, input_keys, object_key
from lgrasp.field.params import FieldParams
from lgrasp.hand.find import find_hand
from lgrasp.hand.params import LISTED, HandParams, ThumbBend
from lgrasp.object.params import ObjectParams


def test_where_the_thumb_is_gives_another_field_of_the_same_hand():
    thumb = ThumbBend(link="link_15.0_tip", place="adducted", axis=(0, 1, 0), normal=(1, 0, 0), angle=50)
    plain, asked = (
        input_keys(find_hand("allegro"), None, 1.0, ObjectParams(), FieldParams(), hands)
        for hands in (LISTED, HandParams(thumb=thumb))
    )
    assert plain.hand == asked.hand
    assert plain.field != asked.field


def test_warnings_of_an_object(tmp_path, cache_root, monkeypatch, said):
    open_box, near = trimesh.creation.box([0.05] * 3), trimesh.creation.box([0.05] * 3)
    open_box.update_faces(range(2, 12))
    near.apply_translation([0.1, 0, 0])
    trimesh.Scene([open_box, near]).export(tmp_path / "pair.glb")
    path, key = object_key(str(tmp_path / "pair.glb"), 1.0, ObjectParams())
    for _ in range(2):
        monkeypatch.setattr("lgrasp.notices._said", set())  # another process
        model = Loader(Cache(cache_root)).object(path, key, 1.0, ObjectParams())
    assert model.notes[0] == "joined 2 geometries into one object"
    told = [f"object 'pair': {note}" for note in model.notes if note.startswith(("joined", "not watertight"))]
    assert len(told) == 2
    assert said == told * 2
