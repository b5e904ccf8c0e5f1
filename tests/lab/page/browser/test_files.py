"""Presets, scenario files, links, recorded runs, rows of studies."""

from io import BytesIO

import numpy as np
import pytest
from matplotlib.image import imread

from browser_checks import arrived, painted, show
from chromium import NO_WEBGL
from fake_page import until
from flexneedle.lab.page.protocol import JobMessage, RunsMessage, StudyRowsMessage
from flexneedle.lab.page.shape_frames import FrameSource
from recorded_page import MANY, insertion, period_frames, rows, session, study_rows

pytestmark = pytest.mark.page

FILES, SECTION = "[data-panel=files]", "[data-panel=section] canvas"
TEXT = 'name = "mine"\n[target]\ndepth_mm = 33.0\n'


@pytest.fixture
def files(visit, server):
    server.files["/scenario.toml"] = TEXT

    def opened(**how):
        return visit(shows=["files"], **how)

    return opened


DROPPED = """(element, text) => {
  const dataTransfer = new DataTransfer();
  dataTransfer.items.add(new File([text], "dropped.toml"));
  const drop = (type) => element.dispatchEvent(new DragEvent(type, { bubbles: true, cancelable: true, dataTransfer }));
  return ["dragover", "drop"].map((type) => !drop(type));
}"""
"""Drop a file on an element; return whether the page accepts it, since the browser would open it otherwise."""


def payload(name, data):
    return {"name": name, "mimeType": "application/toml", "buffer": data}


def test_a_scenario_is_begun_from_preset_world_and_file_and_saved_and_changes_are_not_lost(
    files, server, tmp_path
):
    page = files()
    page.select_option("#files-preset", "phantom")
    page.click("[aria-label='Begin with the preset']")
    page.fill("[aria-label='Number of a random world']", "7")
    page.click("text=Random world")
    assert [each["name"] for each in server.wait_for("preset", 2)] == ["phantom", "wide:7"]
    page.set_input_files(f"{FILES} input[type=file]", payload("my ü.toml", TEXT.encode()))
    assert server.wait_for("load") == [{"type": "load", "name": "my _.toml", "text": TEXT}]
    page.set_input_files(f"{FILES} input[type=file]", payload("large.toml", b"x" * 200_001))
    page.wait_for_selector("text=must have at most 200000")
    assert page.eval_on_selector(f"{FILES} .runs", DROPPED, TEXT) == [True, True]
    loaded = server.wait_for("load", 2)
    assert loaded[1:] == [{"type": "load", "name": "dropped.toml", "text": TEXT}]
    with page.expect_download() as download:
        page.click("text=Save the scenario")
    assert download.value.suggested_filename == "scenario.toml"
    download.value.save_as(tmp_path / "saved.toml")
    assert (tmp_path / "saved.toml").read_text() == TEXT
    server.send(session(2).model_copy(update={"changed": ["target.depth_mm"]}))
    arrived(page)
    assert page.input_value("#files-preset") == "phantom"  # as chosen

    def begin(kind):
        if kind == "preset":
            page.click("[aria-label='Begin with the preset']")
        else:
            page.set_input_files(f"{FILES} input[type=file]", payload("my.toml", TEXT.encode()))

    for kind, words in (("preset", "To begin with phantom"), ("load", "To load my.toml")):
        asked = len(server.asked(kind))
        for button in ("Keep this scenario", "Load" if kind == "load" else "Begin"):
            begin(kind)
            page.wait_for_selector(f"{FILES} >> text={words} drops the changes")
            assert len(server.asked(kind)) == asked
            status = page.locator(f"{FILES} [role=status]", has_text="drops the changes")
            status.get_by_role("button", name=button, exact=True).click()
            until(page, f"!document.querySelector('{FILES}').textContent.includes('drops the changes')")
        server.wait_for(kind, asked + 1)


def download_two_files(page, errors):
    """Download a file that the server refuses, and another one."""
    held = []
    page.route("**/runs/first/*", lambda route, _request: held.append(route))

    def requested():
        while not held:
            painted(page)
        return held.pop()

    page.click("[aria-label='CSV of first']")
    page.wait_for_selector("text=CSV of first is being made…")
    requested().fulfill(status=404, body="the run has no trace\n")
    page.wait_for_selector("text=CSV of first: the run has no trace")
    page.click("[aria-label='Run folder of first']")
    page.wait_for_selector("text=Run folder of first is being made…")
    assert not page.is_visible("text=the run has no trace")
    with page.expect_download() as download:
        requested().fulfill(body=b"PK")
    assert download.value.suggested_filename == "first-run.zip"
    page.wait_for_selector("text=is being made…", state="detached")
    page.unroute("**/runs/first/*")
    assert len(errors) == 1  # the browser's own line of the refusal
    errors.clear()


def test_a_run_is_opened_compared_closed_downloaded_and_saved(files, server, visit):
    page = files()
    page.click("[aria-label='Open first']")
    page.click("[aria-label='Compare with first']")
    page.click("summary:has-text('Download')")
    links = page.locator(".run a").evaluate_all("all => all.map((one) => one.getAttribute('href'))")
    assert links == [f"/runs/first/{file}" for file in ("figure.png", "trace.csv", "run.zip", "replay.html")]
    server.send(insertion("done", of="first"), rows(0, 3, "first"), *period_frames(2, FrameSource.FIRST))
    page.click("[aria-label='Close phantom3d']")
    assert server.wait_for("open", 3) == [
        {"type": "open", "name": "first", "second": False},
        {"type": "open", "name": "first", "second": True},
        {"type": "open", "name": None, "second": False},
    ]
    page.focus("[aria-label='CSV of first']")
    first = {"name": "first", "kind": "insertion", "summary": "changed", "made": 1.7e9}
    server.send(RunsMessage(runs=[MANY, first]))
    page.wait_for_selector("text=changed")
    assert page.locator(".run strong").all_inner_texts() == ["many", "first"]
    assert page.evaluate("document.activeElement.getAttribute('aria-label')") == "CSV of first"
    download_two_files(page, visit.errors)
    server.send(RunsMessage(runs=[MANY]))
    page.wait_for_selector("text=changed", state="detached")
    assert not page.is_visible("[aria-label='Name of the run to save']")
    server.send(insertion("done", name="world:7"))
    until(
        page,
        "/^world-7-adaptive-mpc-20[0-9-]{17}$/.test(document.querySelector('.files form.tools input').value)",
    )
    page.fill("[aria-label='Name of the run to save']", "../x")
    page.click("text=Save the insertion")
    page.wait_for_selector(
        "text=The name must begin with a letter (A–Z, a–z) or digit, and have at most 80 of these"
    )
    page.fill("[aria-label='Name of the run to save']", "my run")
    page.click("text=Save the insertion")
    server.wait_for("save")
    server.send(
        insertion("done", of="first", name="mine"),
        insertion("done", of="second", name="many, row 17", row=17),
    )
    page.wait_for_selector("text=Compared with: many, row 17")
    assert page.locator("text=Save as a run").count() == 1
    name = page.locator("[aria-label='Name to save many row 17 as']")
    assert name.input_value() == "many row 17"
    name.fill("worst")
    server.send(insertion("done", of="first", name="other"))
    page.wait_for_selector("text=Shown: other")
    page.click("text=Save as a run")
    assert server.wait_for("save", 2) == [
        {"type": "save", "name": "my run", "of": "live"},
        {"type": "save", "name": "worst", "of": "second"},
    ]


def test_rows_of_a_study_are_listed_computed_opened_and_compared(files, server):
    server.news[-1] = RunsMessage(runs=[MANY])
    server.answers["study"] = study_rows
    page = files()
    assert not page.is_visible("text=Worst first")
    page.click("[aria-label='Rows of many']")
    page.wait_for_selector("text=many: Many targets, 149 of 150 rows")
    entries = page.locator("[aria-label='Rows of the study'] li").all_inner_texts()
    assert entries[0].split("\n")[:2] == ["Row 17", "done, 0.221 mm off: base, adaptive-mpc, target 40, 5 mm"]
    refused = ["Row 9", "refused: base, adaptive-mpc, target 40, 5, 3 mm", "plan misses"]
    assert entries[2].split("\n") == refused
    assert entries[3] == "3 of 149 finished rows: choose the first row for others"
    assert page.locator("[aria-label='Open row 9']").count() == 0
    page.click("[aria-label='Open row 17']")
    page.click("[aria-label='Compare with row 3']")
    page.fill("[aria-label='First row']", "120")
    page.click("text=From this row")
    page.wait_for_selector("text=Row 120")
    page.click("text=Worst first")
    page.wait_for_selector("text=Row 17")
    assert server.asked("open") == [
        {"type": "open", "name": "many", "row": 17, "second": False},
        {"type": "open", "name": "many", "row": 3, "second": True},
    ]
    assert server.asked("study") == [
        {"type": "study", "name": "many"},
        {"type": "study", "name": "many", "index": 120},
        {"type": "study", "name": "many", "index": None},
    ]
    server.send(JobMessage(job=7, kind="row", state="running", share=0.4, text="many, row 17"))
    page.wait_for_selector("text=Computing again: many, row 17")
    page.click("[aria-label='Cancel: Computing again']")
    assert server.wait_for("cancel") == [{"type": "cancel", "job": 7}]
    server.send(StudyRowsMessage(name="many", title="Many", insertions=150, finished=0, index=None, rows=[]))
    page.wait_for_selector("text=No row is finished yet")


@pytest.fixture
def saved(tmp_path):
    """A function that returns the bytes of a saved picture."""

    def download(page):
        with page.expect_download() as download:
            page.click("text=Picture")
        path = tmp_path / download.value.suggested_filename
        download.value.save_as(path)
        return path.read_bytes()

    return download


def test_pictures_are_of_the_shown_view(files, server, saved):
    page = files(draws=True)
    page.wait_for_selector("[data-panel=space] .legend li")
    picture = imread(BytesIO(saved(page)))
    size = "({ width, height }) => [height, width]"
    assert list(picture.shape[:2]) == page.eval_on_selector("[data-panel=space] canvas", size)
    assert len(np.unique(picture.reshape(-1, picture.shape[2]), axis=0)) > 50
    show(page, "section")
    page.set_viewport_size({"width": 1180, "height": 700})
    painted(page)
    picture = imread(BytesIO(saved(page)))
    assert list(picture.shape[:2]) == page.eval_on_selector(SECTION, size)
    page = files(width=390, before=NO_WEBGL)
    assert "no WebGL" in page.inner_text(".scene > [role=note]")
    page.wait_for_selector(f"{SECTION}:visible")
    before = saved(page)
    server.send(insertion("done", of="first"), rows(0, 4, "first"), *period_frames(3, FrameSource.FIRST))
    arrived(page)
    assert saved(page) != before
