"""A browser for the tests of the page, Debian's Chromium; a fake server and a page for each test."""

import os
from pathlib import Path

import pytest

from browser_checks import loaded, show
from chromium import ARGUMENTS, CHROMIUM
from fake_page import PATIENCE_S, FakePage

# Drawing the view in space in software takes as long as the rest of a test.
DRAWS_NOTHING = """for (const name of ["drawArrays", "drawElements", "drawArraysInstanced", "drawElementsInstanced"]) {
  WebGL2RenderingContext.prototype[name] = () => {};
}"""


@pytest.fixture(scope="session")
def browser():
    if CHROMIUM is None:
        pytest.skip("no chromium on the path: apt-get install chromium")
    sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install playwright")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def kept_server():
    from flexneedle.lab.page.server.catalog import build_catalog

    with FakePage(build_catalog().schema) as server:
        yield server


@pytest.fixture
def server(kept_server):
    """A server of the page's files; a test that has one before its tabs ends with nobody connected.

    A request that the page's server would refuse as no request fails the test.
    """
    yield kept_server
    assert kept_server.reset() == []


@pytest.fixture
def pictures():
    """A function that keeps a picture of a page or of a part of it where SCREENSHOTS names a folder."""

    def kept(shown, name):
        if folder := os.environ.get("SCREENSHOTS"):
            shown.screenshot(path=Path(folder) / f"{name}.png")

    return kept


@pytest.fixture(scope="session")
def kept_tabs():
    """Tabs that one test leaves to the next, by whether WebGL draws: to start one takes longer than most tests."""
    return {}


@pytest.fixture
def tab(browser, kept_tabs):
    """A function that opens an empty tab. Errors on its pages, in `errors`, fail the test at its end.

    before: a script that runs first; draws: whether WebGL draws; touch: whether the screen is touched.
    """
    kept, fresh, errors = [], [], []

    def failed(error):
        errors.append(str(error))

    def printed(message):
        if message.type == "error":
            errors.append(message.text)

    def made(before, draws, touch=False):
        page = browser.new_context(has_touch=touch).new_page()
        page.set_default_timeout(1000 * PATIENCE_S)
        for script in ("" if draws else DRAWS_NOTHING, before):
            if script:
                page.add_init_script(script)
        return page

    def opened(width, height, scheme, before=None, draws="SCREENSHOTS" in os.environ, touch=False):
        if before or touch or any(draws == as_kept for as_kept, _ in kept):
            page = made(before, draws, touch)
            fresh.append(page)
        else:
            page = kept_tabs.pop(draws, None) or made(None, draws)
            kept.append((draws, page))
        page.on("pageerror", failed)
        page.on("console", printed)
        page.set_viewport_size({"width": width, "height": height})
        page.emulate_media(color_scheme=scheme)
        return page

    opened.errors = errors
    yield opened
    for page in fresh:
        page.context.close()
    for draws, page in kept:
        page.evaluate("localStorage.clear()")
        page.goto("about:blank")
        page.mouse.move(0, 0)
        page.remove_listener("pageerror", failed)
        page.remove_listener("console", printed)
        kept_tabs[draws] = page
    assert not errors


@pytest.fixture
def visit(server, tab):
    """A function that opens the page and returns it once its panels and the news are there.

    news: messages and frames for it (default: an opening); before: a script that runs first; ready: awaited selectors;
    shows: view and tab to show, by their panels.
    """

    def opened(
        news=None,
        *,
        width=1280,
        height=800,
        scheme="light",
        before=None,
        ready=(),
        shows=(),
        **how,
    ):
        server.news = news or server.news
        page = tab(width, height, scheme, before, **how)
        page.goto(server.url)
        loaded(page)
        for panel in shows:
            show(page, panel)
        for selector in [ready] if isinstance(ready, str) else ready:
            page.wait_for_selector(selector)
        return page

    opened.errors = tab.errors
    return opened
