"""The documentation site: built without a warning, read in a browser, found by its own search."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.chromium import Browser, browser, chromium

pytestmark = pytest.mark.slow
"""Links between the pages are looked at by the quick tests, too."""

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    assert "WARNING" not in built.stderr
    return folder


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Browser]:
    """Return a page in a browser."""
    if chromium() is None:
        pytest.skip("no Chromium")
    with browser(tmp_path / "profile") as opened:
        yield opened


def test_every_page_opens_without_an_error_a_foreign_request_or_a_dead_link(
    site: Path, page: Browser
) -> None:
    pages = sorted(path for path in site.rglob("*.html") if path.name != "404.html")
    assert len(pages) > 20
    ids: dict[str, set[str]] = {}
    links: list[tuple[str, str]] = []
    for path in pages:
        page.open(path)
        name = path.as_uri()
        ids[name] = set(page.evaluate("Array.from(document.querySelectorAll('[id]'), e => e.id)"))
        hrefs = page.evaluate("Array.from(document.querySelectorAll('a[href]'), e => e.href)")
        links += [(name, href) for href in hrefs]
        assert page.complaints == [], path.name
        assert (
            page.evaluate("document.querySelectorAll('merror, .arithmatex:not(:has(math))').length")
            == 0
        ), path.name
        broken = "Array.from(document.images).filter(i => !i.naturalWidth).map(i => i.src)"
        assert page.evaluate(broken) == [], path.name
    assert [url for url in page.requests if not url.startswith(("file:///", "data:"))] == []

    dead = []
    for source, href in links:
        target, _, anchor = href.partition("#")
        if not target.startswith("file:"):
            continue
        exists = target in ids or Path(target.removeprefix("file://")).is_file()
        if not exists or (anchor and target in ids and anchor not in ids[target]):
            dead.append((source, href))
    assert dead == []


def test_a_search_finds_a_parameter(site: Path, page: Browser) -> None:
    page.open(site / "index.html")
    page.wait_for("window.Worker !== undefined && document.readyState === 'complete'")
    page.evaluate(
        "document.querySelector('#__search').click();"
        "const query = document.querySelector('.md-search__input');"
        "query.focus(); query.value = 'latched_faults';"
        "query.dispatchEvent(new KeyboardEvent('keyup', {bubbles: true}));"
        "query.dispatchEvent(new Event('input', {bubbles: true}))"
    )
    found = "Array.from(document.querySelectorAll('.md-search-result__link'), e => e.href)"
    page.wait_for(f"({found}).length > 0")
    assert any("reference/parameters.html" in href for href in page.evaluate(found))
    assert page.complaints == []
