"""What a pipeline asks for that a hand cannot give."""

import shutil

from lgrasp.engine.pipeline import load_pipeline
from lgrasp.hand.find import find_hand
from lgrasp.jobs.hands import for_hand


def test_more_contacts_than_a_hand_has_fingers_are_told(said):
    for_hand(load_pipeline("robust").with_params("search", contacts=(5,)), "allegro")
    assert said == ["hand 'allegro': search.contacts is 4, not 5: its fingers"]


def test_more_contacts_than_fingers_in_the_rules_of_the_hand_are_told(said, tmp_path):
    rules = (find_hand("allegro").urdf.parent / "hand.yaml").read_text()
    (tmp_path / "hand.yaml").write_text(f"{rules}\ncontacts: [9]\n")
    shutil.copy(find_hand("allegro").urdf, tmp_path)
    for_hand(load_pipeline("robust"), str(tmp_path))
    assert said == ["hand 'allegro': contacts is 4, not 9: its fingers"]


def test_contacts_of_all_fingers_are_fine(said):
    for_hand(load_pipeline("robust").with_params("search", contacts=(2, 4)), "allegro")
    assert said == []


def test_a_grasp_type_without_the_palm_needs_its_fingers_alone(said):
    """Where fingers close, each touches once."""
    tripod = for_hand(load_pipeline("power").with_steering(grasp_type="tripod"), "barrett")
    assert tripod.bounds.min_contacts == 3
    assert said == ["hand 'barrett': bounds.min_contacts is 3, not 5: its fingers"]
    assert for_hand(load_pipeline("power"), "barrett").bounds.min_contacts == 4
    assert for_hand(load_pipeline("power").with_steering(grasp_type="tripod"), "allegro").bounds.min_contacts == 5
