"""Actions of benchmarks/page.py on the page, by pointer like a person."""

import re
import time
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser, Page

PROBE = Path(__file__).with_name("page_probe.js")
VIEWPORT = {"width": 1280, "height": 1000}
PATIENCE_MS = 300_000
STEP_S, MOVES = 0.016, 30
"""Of a drag: half a second."""
PLANES = {1: ("x–y", "target"), 2: ("x–y", "x–z", "target")}
"""Planes of the section in which a target is dragged, by the number of axes."""
DEPTHS, SHARES = (0.6, 1.05), (-0.125, 0.125)
"""Of the targets: of the scenario's own depth, and lateral offsets of the depth, as in the paper."""
MODIFIED = {"control.adaptive_mpc.paths": 64}
"""So that 64 paths are sampled in each period."""
SECTION, STATUS = "[data-panel=section]", "[data-panel=status]"
VIEWS = {"section": SECTION, "plots": "[data-panel=plots]"}
"""Panels in view while an insertion plays: the section in place of the scene in space, plots beside it."""


def new_page(browser: Browser, address: str) -> Page:
    """Return a page in a new browser window, after its first picture."""
    context = browser.new_context(viewport=VIEWPORT)
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.add_init_script(path=PROBE)
    page.goto(address)
    until(page, "window.probe.first !== null")
    return page


def until(page: Page, condition: str) -> None:
    """Wait until a condition in JavaScript holds; it is checked every 50 ms."""
    page.evaluate(
        f"""() => new Promise((resolve, reject) => {{
          const deadline = performance.now() + {PATIENCE_MS};
          const check = () => {{
            if ({condition}) resolve();
            else if (performance.now() > deadline) reject(new Error({condition!r}));
            else setTimeout(check, 50);
          }};
          check();
        }})"""
    )


def loaded(page: Page, name: str) -> None:
    """Begin with a scenario, whose plan is then made."""
    answer = page.evaluate("name => flexneedle.link.ask({type: 'preset', name})", name)
    if not answer["done"]:
        raise RuntimeError(answer["reason"])
    _until_planned(page)


def _until_planned(page: Page) -> None:
    """Wait for plan and scene of the present revision."""
    present = "flexneedle.store.get('session').revision"
    until(
        page,
        f"!flexneedle.store.get('draft') && flexneedle.store.get('plan manipulation')?.revision === {present}"
        f" && flexneedle.store.get('scene')?.revision === {present}",
    )


def inserted(page: Page) -> None:
    """Start an insertion in real time with 64 sampled paths, and wait until it runs."""
    page.evaluate("values => flexneedle.link.edit(values)", MODIFIED)
    _until_planned(page)
    page.locator("[data-panel=actions]").get_by_role("button", name="Insert", exact=True).click()
    until(page, "flexneedle.store.get('insertion live')?.state === 'running'")
    until(page, "flexneedle.store.get('shape samples live')?.paths === 64")


def until_ended(page: Page) -> None:
    """Wait until the insertion has ended."""
    until(page, "flexneedle.store.get('insertion live').state !== 'running'")


class Pointer:
    """The pointer on a page."""

    def __init__(self, page: Page, rng: np.random.Generator) -> None:
        self._page, self._rng = page, rng
        self._deepest = float(page.evaluate("flexneedle.store.get('scene').target[0]"))

    def drag_target(self) -> dict[str, Any]:
        """Drag the target to a random place in the section, and wait for the plan; what the probe has noted."""
        page, rng = self._page, self._rng
        axes = page.evaluate("flexneedle.store.get('scene').axes")
        self._show(SECTION)
        page.click(f"{SECTION} [data-plane='{rng.choice(PLANES[axes])}']")
        depth, share = self._deepest * rng.uniform(*DEPTHS), rng.uniform(*SHARES)
        begin, end = page.evaluate("([depth, share]) => probe.places(depth, share)", [depth, share])
        page.evaluate("probe.reset()")
        page.mouse.move(*begin)
        page.mouse.down()
        for k in range(1, MOVES + 1):
            page.mouse.move(*(np.add(begin, np.subtract(end, begin) * k / MOVES)).tolist())
            time.sleep(STEP_S)
        page.mouse.up()
        _until_planned(page)
        page.evaluate("new Promise((resolve) => setTimeout(resolve, 100))")  # so that it is painted
        return dict(page.evaluate("probe"))

    def click_until_ended(self, view: str) -> None:
        """Click on a plane of the section if that is in view, or on the steering, at random times until the insertion
        has ended."""
        page, rng = self._page, self._rng
        self._show(VIEWS[view])
        while page.evaluate("flexneedle.store.get('insertion live').state") == "running":
            if view == "section" and rng.random() < 0.5:
                self._click(f"{SECTION} [data-plane='{rng.choice(PLANES[2])}']")
            else:
                self._click(f"{STATUS} .steering button")
            time.sleep(rng.uniform(0.1, 0.4))

    def _click(self, what: str) -> None:
        box = self._page.locator(what).bounding_box()
        if box is not None:
            self._page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)

    def _show(self, what: str) -> None:
        key = "view scene" if what == SECTION else "view tab"
        self._page.evaluate(
            "([key, name]) => flexneedle.store.set(key, name)", [key, re.findall("=(.*)]", what)[0]]
        )
