"""Drafts of Allegro that several files look at, made once."""

import pytest
from support.places import ROOT

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
