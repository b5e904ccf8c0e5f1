"""A browser for the tests of the page, Debian's Chromium; a fake server and a page for each test."""

import os
from pathlib import Path

import pytest

from chromium import ARGUMENTS, CHROMIUM


@pytest.fixture(scope="session")
def browser():
    if CHROMIUM is None:
        pytest.skip("no chromium on the path: apt-get install chromium")
    sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install playwright")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture
def server():
    from fake_page import FakePage
    from flexneedle.page.server.catalog import SCHEMA

    with FakePage(SCHEMA) as server:
        yield server


@pytest.fixture
def pictures():
    """A function that keeps a picture of a page or of a part of it where SCREENSHOTS names a folder."""

    def kept(shown, name):
        if folder := os.environ.get("SCREENSHOTS"):
            shown.screenshot(path=Path(folder) / f"{name}.png")

    return kept


@pytest.fixture
def visit(browser, server):
    """A function that opens the page and returns it. Errors on the page, in `errors`, fail the test at its end."""
    contexts, errors = [], []

    def opened(
        width=1280,
        height=800,
        scheme="light",
        before=None,
        tour=False,
        ready="[data-panel=status] .connection",
    ):
        context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(20_000)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        if not tour:
            page.add_init_script("if (origin !== 'null') localStorage.setItem('flexneedle tour', 'seen')")
        if before:
            page.add_init_script(before)
        page.goto(server.url)
        page.wait_for_selector(ready)
        return page

    opened.errors = errors
    yield opened
    for context in contexts:
        context.close()
    assert not errors
