"""Pages: every relative link leads somewhere, and every page can be reached from docs/index.md."""

import re
from pathlib import Path

import pytest
from support.places import ROOT

from lgrasp.grasp.outcomes import METRICS
from lgrasp.hold.run import METRICS as HOLD_METRICS

DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *ROOT.glob("hands/*/*.md")])
LINK = re.compile(r"\]\(([^)\s]+)\)")


def text_of(page: Path) -> str:
    """A page without its code."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"`[^`\n]*`", lambda code: code[0].replace("](", "] ("), text)


def links(page: Path) -> list[tuple[Path, str]]:
    """(file, anchor) of every relative link."""
    found = [target.partition("#") for target in LINK.findall(text_of(page)) if "://" not in target]
    return [((page.parent / path).resolve() if path else page, anchor) for path, _, anchor in found]


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as they are made on GitHub."""
    headings = re.findall(r"^#+ +(.*?) *$", text_of(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target, anchor in links(page):
        assert target.exists(), f"{page.relative_to(ROOT)} links to {target}, which is not there"
        if anchor:
            assert anchor in anchors(target), f"{page.relative_to(ROOT)}: {target.name} has no heading #{anchor}"


def test_all_pages_are_reached():
    seen, new = set(), [DOCS / "index.md"]
    while new:
        page = new.pop()
        seen.add(page)
        new += {target for target, _ in links(page) if target.suffix == ".md" and target.exists()} - seen
    assert set(DOCS.rglob("*.md")) <= seen


def test_every_metric_is_explained():
    page = (DOCS / "reference" / "metrics.md").read_text(encoding="utf-8")
    names = (*METRICS, "contacts", "valid", "refined", "energy", "room")
    assert [name for name in names if f"- `{name}`" not in page] == []
    assert [name for name in HOLD_METRICS if f"`{name}`" not in page] == []


def test_commands_can_be_pasted_into_any_shell():
    """zsh takes a comment behind a command as its arguments."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert re.findall(r"^\$? ?(?:lgrasp|pip|make) [^`|]* # .*", text, flags=re.MULTILINE) == [], page


def test_pages_are_short():
    words = sum(len(page.read_text(encoding="utf-8").split()) for page in DOCS.rglob("*.md"))
    assert words <= 25_000, f"docs have {words} words: tell each fact once, and link to it"
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120
