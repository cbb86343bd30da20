"""The documentation site: it builds without a warning, no link is dead, no page scrolls sideways."""

import functools
import http.server
import re
import threading
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType

import pytest
from tests.kit.browser import CHROMIUM, Browser
from tests.kit.loaded import loaded

pytestmark = pytest.mark.timeout(600)

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site() -> ModuleType:
    return loaded(ROOT / "docs/site.py")


@pytest.fixture(scope="module")
def sources(site: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages as zensical gets them."""
    source = tmp_path_factory.mktemp("sources") / "docs"
    site.gather(source)
    return source


def test_each_link_of_the_site_has_a_file(sources: Path) -> None:
    links = [
        (path, link)
        for path in sources.rglob("*.md")
        if "." not in path.stem  # not a file of another kind, shown on a page
        for link in re.findall(r"\]\(([^)\s#]+)[^)\s]*\)", path.read_text())
        if not link.startswith("http")
    ]
    assert len(links) > 100
    assert [(path.name, link) for path, link in links if not (path.parent / link).exists()] == []


class Names(HTMLParser):
    """Where a built page leads, and the places in it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.places: set[str] = {""}
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id":
                self.places.add(value or "")
            if name in {"href", "src"} and value and not re.match("[a-z]+:", value):
                self.links.append(value)


@pytest.fixture(scope="module")
def built(site: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("zensical", reason="pip install 'zensical>=0.0.73'")
    into = tmp_path_factory.mktemp("site") / "site"
    assert site.build(into) == 0  # strict: a warning is an error
    return into


def test_no_link_of_the_built_site_is_dead(built: Path) -> None:
    found = {path: Names(path) for path in built.rglob("*.html") if path.name != "404.html"}
    assert len(found) > 30
    for path, page in found.items():
        for link in page.links:
            target, _, place = link.partition("#")
            leads = (path.parent / target).resolve() if target else path
            assert leads.exists(), (path, link)
            if leads in found:
                assert place in found[leads].places, (path, link)


@pytest.fixture
def address(built: Path) -> Iterator[str]:
    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None: ...

    handler = functools.partial(Quiet, directory=str(built))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


BAD = """Promise.all([...document.images].map(image => {
  image.loading = "eager";
  return image.decode().then(() => image.naturalWidth ? "" : image.src, () => image.src);
})).then(found => found.filter(Boolean))"""
"""In a page: the pictures that cannot be shown."""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed; apt install chromium")
def test_each_page_is_whole_in_chromium(built: Path, sources: Path, address: str, tmp_path: Path) -> None:
    """At two widths: it does not scroll sideways, its pictures load, and it has its code blocks."""
    browser = Browser(tmp_path)
    pages = [
        str(path.relative_to(built)) for path in sorted(built.rglob("*.html")) if path.name != "404.html"
    ]
    wide, bad, codeless = {}, {}, []
    for width in (1440, 390):
        for page in pages:
            browser.open(f"{address}/{page}", width)
            browser.until(f"document.readyState === 'complete' && location.pathname === '/{page}'")
            wide[page, width] = browser.value("document.documentElement.scrollWidth") - width
            bad[page, width] = browser.value(BAD)
            source = (sources / page).with_suffix(".md")
            text = (source if source.exists() else source.with_name("README.md")).read_text()
            if re.search(r"^(```|    \S)", text, re.MULTILINE) and not browser.value(
                "document.querySelectorAll('article pre code').length"
            ):
                codeless.append(page)
    answers = [
        one["params"]["response"] for one in browser.events if one.get("method") == "Network.responseReceived"
    ]
    browser.close()
    assert {page: over for page, over in wide.items() if over > 0} == {}
    assert {page: links for page, links in bad.items() if links} == {}
    assert codeless == []
    assert len(answers) >= len(pages)
    assert [
        one["url"] for one in answers if one["status"] >= 400 or not one["url"].startswith((address, "data:"))
    ] == []


ROOM = "[...document.querySelectorAll('*')].find(one => one.shadowRoot)?.shadowRoot"
"""In a page: what the search draws in."""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed; apt install chromium")
def test_search_works_without_a_server(built: Path, address: str, tmp_path: Path) -> None:
    browser = Browser(tmp_path)
    for start in (built.as_uri(), address):
        browser.open(f"{start}/how-to/view.html")
        browser.until(f"!!{ROOM}")
        browser.click("[data-md-component=search]")
        browser.until(f"!!{ROOM}.activeElement?.matches('input')")
        for letter in "hottest":
            browser("Input.insertText", text=letter)
        browser.until(f"[...{ROOM}.querySelectorAll('a')].some(one => one.href.includes('view.html'))")
        assert browser.value(f"{ROOM}.querySelector('input').value") == "hottest"
    browser.close()


def test_first_screen_shows_the_product(sources: Path) -> None:
    first = (sources / "index.md").read_text().partition("\n## ")[0]
    assert "](pictures/view.png)" in first
    assert "dxlrun demo" in first
