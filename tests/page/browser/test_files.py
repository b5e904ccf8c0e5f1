"""Presets, scenario files, links, recorded runs."""

import pytest

from fake_page import until
from flexneedle.page.frames import Source
from recorded_page import insertion, period_frames, rows

pytestmark = pytest.mark.page

FILES = "[data-panel=files]"
TEXT = 'name = "mine"\n[target]\ndepth_mm = 33.0\n'


@pytest.fixture
def files(visit, server):
    server.files["/scenario.toml"] = TEXT

    def opened(**how):
        page = visit(ready=f"{FILES} li", **how)
        page.wait_for_selector("text=nobody steers")
        return page

    return opened


def test_a_preset_and_a_random_world_are_begun(files, server):
    page = files()
    page.select_option("#files-preset", "phantom")
    page.click("[aria-label='Begin with the preset']")
    page.fill("[aria-label='Number of a random world']", "7")
    page.click("text=Random world")
    page.wait_for_timeout(100)
    assert [each["name"] for each in server.asked("preset")] == ["phantom", "world:7"]


def test_a_file_is_loaded(files, server):
    page = files()
    payload = {"name": "my ü.toml", "mimeType": "application/toml", "buffer": TEXT.encode()}
    page.set_input_files(f"{FILES} input[type=file]", payload)
    page.wait_for_selector("text=you steer")
    page.wait_for_timeout(100)
    assert server.asked("load") == [{"type": "load", "name": "my _.toml", "text": TEXT}]


def test_a_file_that_is_too_large_is_not_sent(files, server):
    page = files()
    payload = {"name": "large.toml", "mimeType": "application/toml", "buffer": b"x" * 200_001}
    page.set_input_files(f"{FILES} input[type=file]", payload)
    page.wait_for_selector("text=must have at most 200000")
    assert not server.asked("load")


def test_a_link_reproduces_scenario_and_options(files, server):
    page = files()
    page.click("text=Copy a link")
    until(page, "location.hash.startsWith('#state=')")
    address = page.url
    page.goto("about:blank")
    page.goto(address)
    page.wait_for_selector("text=you steer")
    until(page, "!location.hash")
    page.wait_for_timeout(200)
    assert server.asked("load") == [{"type": "load", "name": "phantom3d", "text": TEXT}]
    assert server.asked("options") == [
        {"type": "options", "seed": 0, "strategy": "manipulation", "controller": "adaptive-mpc"}
    ]


def test_a_damaged_link_is_reported(files, server):
    page = files()
    page.evaluate("() => { location.hash = '#state=x'; }")
    page.wait_for_selector("text=The link is damaged")
    assert not server.asked("load")


def test_a_run_is_opened_compared_closed_and_downloaded(files, server):
    page = files()
    page.click("[aria-label='Open first']")
    page.click("[aria-label='Compare with first']")
    page.click("summary:has-text('Download')")
    links = page.locator(".run a").evaluate_all("all => all.map((one) => one.getAttribute('href'))")
    assert links == [f"/runs/first/{file}" for file in ("figure.png", "trace.csv", "run.zip", "replay.html")]
    server.send(insertion("done", of="first"), rows(0, 3, "first"), *period_frames(2, Source.FIRST))
    page.click("[aria-label='Close phantom3d']")
    page.wait_for_timeout(100)
    assert server.asked("open") == [
        {"type": "open", "name": "first", "second": False},
        {"type": "open", "name": "first", "second": True},
        {"type": "open", "name": None, "second": False},
    ]


def test_an_insertion_that_has_ended_is_saved(files, server):
    page = files()
    assert not page.is_visible("[aria-label='Name of the run to save']")
    server.send(insertion("done"))
    page.fill("[aria-label='Name of the run to save']", "../x")
    page.click("text=Save the insertion")
    page.fill("[aria-label='Name of the run to save']", "my run")
    page.click("text=Save the insertion")
    page.wait_for_timeout(100)
    assert server.asked("save") == [{"type": "save", "name": "my run"}]


def test_a_picture_of_the_scene_is_saved(files):
    page = files()
    page.wait_for_selector("[data-panel=space] .legend li")
    with page.expect_download() as download:
        page.click("text=Picture")
    assert download.value.suggested_filename == "flexneedle.png"

