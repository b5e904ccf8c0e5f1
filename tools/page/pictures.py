"""Draw the pictures of the page for README and docs/page.md: docs/images/page*.png.

    python tools/page/pictures.py [--out docs/images]

Serves the page, plans, inserts and disturbs there as a user would, and takes pictures of it in Debian's Chromium, which
has to be on the path.
"""

import argparse
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from shutil import which
from tempfile import TemporaryDirectory
from typing import Literal

from playwright.sync_api import Browser, Page, sync_playwright

_ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
_WAIT_MS, _POLL_MS = 120_000, 100
_PAINTED_MS = 3000  # in space, by software
_ENDED = "['done', 'held', 'failed'].includes(flexneedle.store.get('insertion live')?.state)"
_COMPARED = "flexneedle.store.get('job compare')?.state === 'done'"


@contextmanager
def _served(scenario: str) -> Iterator[str]:
    """Serve the page; yield its address."""
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "flexneedle", "serve", scenario, "--runs", folder]
        command += ["--port", "0", "--no-open"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                yield next(iter(process.stdout or ())).strip()
            finally:
                process.terminate()


@contextmanager
def _visited(
    browser: Browser, address: str, width: int, height: int, scheme: Literal["light", "dark"]
) -> Iterator[Page]:
    """Open the page with a plan."""
    context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
    page = context.new_page()
    page.set_default_timeout(_WAIT_MS)
    page.goto(address)
    _await(page, "window.flexneedle?.store.get('scene')")
    _hide(page, "WebGL runs in software")  # as here, without a graphics card
    yield page
    context.close()


def _await(page: Page, condition: str) -> None:
    """Wait until an expression is true on the page, whose policy forbids to evaluate one in it again and again."""
    for _ in range(_WAIT_MS // _POLL_MS):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(_POLL_MS)
    raise TimeoutError(condition)


def _hide(page: Page, text: str) -> None:
    for place in page.get_by_text(text).all():
        place.evaluate("element => { element.hidden = true; }")


def _press(page: Page, panel: str, name: str) -> None:
    page.locator(f"[data-panel={panel}]").get_by_role("button", name=name, exact=True).click()


def _show_tab(page: Page, name: str) -> None:
    page.locator(f"[data-tab={name}]").click()


def _inserted(page: Page, pace: str = "20") -> None:
    """Insert to the end."""
    _press(page, "actions", "Insert")
    page.locator("[aria-label=Pace]").select_option(pace)
    _await(page, _ENDED)


def _shown(page: Page, share: float) -> None:
    """Show the period at a share of the insertion, and wait for its painting."""
    page.evaluate(
        """share => {
            flexneedle.store.set('view period', Math.round(share * flexneedle.store.get('rows live').length));
        }""",
        share,
    )
    page.wait_for_timeout(_PAINTED_MS)


def _draw_insertion(browser: Browser, folder: Path) -> None:
    """In space, in light and, on a telephone, in dark."""
    with _served("phantom3d") as address:
        with _visited(browser, address, 1440, 900, "light") as page:
            _inserted(page)
            _shown(page, 0.75)
            page.screenshot(path=folder / "page.png")
        with _visited(browser, address, 390, 844, "dark") as page:
            _await(page, _ENDED)
            _shown(page, 0.75)
            page.screenshot(path=folder / "page-phone.png")


def _draw_plans(browser: Browser, folder: Path) -> None:
    """Both strategies side by side."""
    with _served("phantom") as address, _visited(browser, address, 1440, 1200, "light") as page:
        page.evaluate("flexneedle.link.edit({'target.depth_mm': 40, 'target.lateral_mm': 1.5})")
        _show_tab(page, "plans")
        _press(page, "plans", "Both strategies")
        _await(page, _COMPARED)
        page.locator("section.plans").screenshot(path=folder / "page-plans.png")


def _draw_disturbance(browser: Browser, folder: Path) -> None:
    """A tip that is pushed half way: what the controller does, in plots and words."""
    with _served("phantom") as address, _visited(browser, address, 1440, 1200, "light") as page:
        _press(page, "actions", "Start paused")
        _await(page, "flexneedle.store.get('insertion live')?.state === 'paused'")
        page.locator("[aria-label=Pace]").select_option("1")  # so slow that it can be paused
        _press(page, "actions", "Continue")
        _await(page, "flexneedle.store.get('rows live')?.length > 30")
        _press(page, "actions", "Pause")
        _await(page, "flexneedle.store.get('insertion live')?.state === 'paused'")
        page.get_by_label("Force on the tip in N").fill("0.02")
        _press(page, "insertion", "Push")
        page.locator("[aria-label=Pace]").select_option("20")
        _press(page, "actions", "Continue")
        _await(page, _ENDED)
        _show_tab(page, "plots")  # which are drawn only on the screen
        page.wait_for_timeout(_PAINTED_MS)
        page.locator("section.plots").screenshot(path=folder / "page-disturbed.png")


def main(argv: Sequence[str] | None = None) -> None:
    """Draw all pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    folder = parser.parse_args(argv).out
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=which("chromium"), args=_ARGUMENTS)
        for draw in (_draw_insertion, _draw_plans, _draw_disturbance):
            draw(browser, folder)
        browser.close()


if __name__ == "__main__":
    main()
