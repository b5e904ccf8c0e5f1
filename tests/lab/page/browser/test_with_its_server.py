"""The page in a browser with its server and workers behind it, as `flexneedle serve` runs them."""

import csv
import zipfile
from dataclasses import replace

import pytest

from browser_checks import loaded, show
from fake_page import until
from flexneedle.lab.page.server.clients import PageLimits
from page_clients import PATIENCE_S, served

pytestmark = pytest.mark.page

PLANS, ACTIONS, INSERTION, PLAYER = (
    f"[data-panel={name}]" for name in ("plans", "actions", "insertion", "player")
)
WORKER = "flexneedle.lab.page.worker"
LIMITS = replace(
    PageLimits(), rest_s=60.0, runs_s=0.2
)  # a changed scenario keeps its estimate until it is planned


@pytest.fixture
def address(tmp_path):
    with served(
        tmp_path / "runs", limits=LIMITS, workers=((WORKER, "plans"), (WORKER, "insertion"))
    ) as server:
        yield server.address


def see(page, selector):
    """Wait for a result of a worker."""
    page.wait_for_selector(selector, timeout=1000 * PATIENCE_S)


def downloaded(page, name, path):
    """Return the path of a link's download."""
    with page.expect_download(timeout=1000 * PATIENCE_S) as download:
        page.click(f"[aria-label='{name}']")
    download.value.save_as(path)
    return path


def test_from_a_plan_to_the_files_of_a_saved_run(address, tab, tmp_path):
    page = tab(1280, 800, "light")
    page.goto(address)
    loaded(page)
    show(page, "plans")
    show(page, "section")
    see(page, f"{PLANS} >> text=Manipulation:")
    depth = page.evaluate("flexneedle.store.get('scene').target[0]")

    page.focus("[data-panel=section] [data-handle=target]")
    page.keyboard.down("ArrowRight")
    see(page, f"{PLANS} >> text=First estimate: ends")
    page.keyboard.up("ArrowRight")
    until(page, f"flexneedle.store.get('scene').target[0] === {depth + 0.5}")
    page.click("[data-work=plan]")
    see(page, f"{PLANS} .words:not(:has-text('earlier state')) >> text=Manipulation:")

    page.locator(ACTIONS).get_by_role("button", name="Insert", exact=True).click()
    see(page, f"{INSERTION} .decisions .now:has-text('Period')")
    page.select_option("[aria-label=Pace]", "2")
    page.locator(INSERTION).get_by_role("button", name="Push", exact=True).click()
    page.wait_for_selector(f"{INSERTION} >> text=Active: push of 0.02 N at 0°")
    page.select_option("[aria-label=Pace]", "20")
    see(page, f"{ACTIONS} >> text=Ended: adaptive-mpc, seed 0,")
    periods = page.evaluate("flexneedle.store.get('insertion live').periods")
    assert periods > 30
    assert page.evaluate("flexneedle.store.get('rows live').map(({ index }) => index)") == list(
        range(periods)
    )

    show(page, "files")
    page.fill("[aria-label='Name of the run to save']", "mine")
    page.click("text=Save the insertion")
    page.click("[aria-label='Open mine']")
    see(
        page,
        f"{PLAYER}:has([aria-pressed=true][data-of=first]) [aria-valuetext^='period {periods} of {periods},']",
    )

    page.click("summary:has-text('Download')")
    with downloaded(page, "CSV of mine", tmp_path / "trace.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == periods
    with zipfile.ZipFile(downloaded(page, "Run folder of mine", tmp_path / "run.zip")) as archive:
        assert {"mine/run.json", "mine/trace.mcap"} <= set(archive.namelist())
        assert archive.testzip() is None
