"""A browser, where Debian's chromium and playwright are, and views in it."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from lgrasp.engine.cache import Cache

FLAGS = (
    "--no-sandbox --disable-gpu --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --no-first-run "
    "--disable-quic --disable-background-networking --disable-component-update --disable-sync"
)


@pytest.fixture(scope="session")
def opened(cache_root: Path) -> Iterator[Callable[..., Any]]:
    """opened(*what, **options): a view on a free port of this computer; (site, view)."""
    pytest.importorskip("viser", reason="viser is not installed (extra view)")
    from lgrasp.view.open import open_view
    from lgrasp.view.server import close_site

    sites = []

    def open_(*what: object, **options: Any) -> Any:
        site, view = open_view([str(w) for w in what], Cache(cache_root), host="127.0.0.1", port=0, **options)
        sites.append(site)
        return site, view

    yield open_
    for site in sites:
        close_site(site)


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    chromium = shutil.which("chromium")
    if not chromium:
        pytest.skip("chromium is not installed")
    api = pytest.importorskip("playwright.sync_api", reason='playwright is not: pip install -e ".[browser]"')
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS.split())
        yield browser
        browser.close()


@pytest.fixture
def page(browser: Any, request: pytest.FixtureRequest) -> Iterator[Callable[[Any], Any]]:
    """page(site): the page of a viewer, its scene drawn; it asks nothing of other computers and meets no error."""
    pages, wrong = [], []

    def visit(site: Any) -> Any:
        page = browser.new_page(viewport={"width": 600, "height": 280})
        pages.append(page)
        page.set_default_timeout(60_000)  # software draws
        here = f"http://127.0.0.1:{site.front.port}"
        page.on("request", lambda r: r.url.startswith((here, "blob:", "data:")) or wrong.append(r.url))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.goto(here)
        page.get_by_text("save model (GLB)").wait_for()
        return page

    yield visit
    for page in pages:
        page.close()
    assert not wrong
