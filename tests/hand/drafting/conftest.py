"""Drafts of Allegro that several files look at, made once."""

import pytest
from support.places import ROOT
from support.urdfs import turned

from lgrasp.hand.drafting.draft import draft_spec
from lgrasp.hand.spec import HandSpec

ALLEGRO = ROOT / "hands" / "allegro" / "hand.urdf"


@pytest.fixture(scope="session")
def allegro() -> tuple[HandSpec, list[str]]:
    """Drafted from the primitive URDF."""
    return draft_spec(ALLEGRO, "drafted")


@pytest.fixture
def no_spaces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Opposition spaces, half of the time of a draft, are not looked for."""
    monkeypatch.setattr("lgrasp.hand.drafting.draft.propose_spaces", lambda *given: ({}, []))


@pytest.fixture(scope="session")
def left(tmp_path_factory: pytest.TempPathFactory) -> HandSpec:
    """Drafted from its mirror image on another base, turned."""
    path = turned(ALLEGRO, tmp_path_factory.mktemp("left"), "1.1 -0.7 2.3", mirror=True)
    return draft_spec(path, "turned")[0]
