"""The scenario by fields: made from the schema, searched, refused with the problem beside the field."""

import pytest

from browser_layout import too_wide
from fake_page import until
from flexneedle.page.messages import Refused, Session
from flexneedle.scenario.files import load_scenario
from recorded_page import WELCOME, opening, people, scene, scene_frames

pytestmark = pytest.mark.page

FORM = "[data-panel=form]"


def session(revision=1, changed=(), doubts=(), seed=0, preset="phantom3d", **values):
    flat = load_scenario(preset).flat() | values
    given = {"reach_since": revision, "seed": seed, "strategy": "manipulation", "controller": "adaptive-mpc"}
    return Session(
        revision=revision, name=preset, values=flat, changed=list(changed), doubts=list(doubts), **given
    )


def field(page, key):
    return page.locator(f"{FORM} [data-key='{key}']")


@pytest.fixture
def form(visit, server):
    """A function that opens the page with a whole scenario and returns it once its form is made."""

    def opened(news=None, **how):
        server.news = news or [WELCOME, people(), session(), scene(), *scene_frames()]
        return visit(ready=f"{FORM} details", **how)

    return opened


def test_every_value_of_a_scenario_has_a_field(form):
    page = form()
    page.fill(f"{FORM} input[type=search]", ".")  # in all keys and descriptions
    shown = set(page.evaluate("[...document.querySelectorAll('[data-key]')].map((each) => each.dataset.key)"))
    values = set(load_scenario("phantom3d").flat())
    lists = {key for key in values if key.startswith("tissue.") and key.endswith(".law")}
    assert values - lists <= shown


def test_a_field_has_label_unit_and_bounds(form):
    page = form()
    depth = field(page, "target.depth_mm")
    assert depth.locator("label").inner_text().split("\n")[0].startswith("Depth")
    assert depth.locator(".unit").inner_text() == "mm"
    assert page.get_by_label("Depth in mm").input_value() == "40"
    offset = field(page, "needle.bevel.offset_mm").locator("input[type=range]")
    assert float(offset.get_attribute("min")) == 0.0
    assert float(offset.get_attribute("max")) == pytest.approx(10.0)


def test_a_value_is_taken_with_enter_and_a_slider_at_once(form, server):
    page = form()
    page.fill("#field-target-depth_mm", "35.5")
    page.press("#field-target-depth_mm", "Enter")
    until(page, "!flexneedle.store.get('draft')")
    assert server.asked("edit")[-1] == {"type": "edit", "values": {"target.depth_mm": 35.5}}
    slider = field(page, "target.lateral_mm").locator("input[type=range]")
    slider.focus()
    slider.press("ArrowRight")
    until(page, "!flexneedle.store.get('draft')")
    assert server.asked("edit")[-1]["values"].keys() == {"target.lateral_mm"}


def test_a_problem_is_beside_its_field_and_the_value_stays(form, server):
    rule = "must be at least 0.0 mm"
    server.answers["edit"] = Refused(what="edit", reason="no", problems={"target.depth_mm": rule})
    page = form()
    page.fill("#field-target-depth_mm", "-3")
    page.press("#field-target-depth_mm", "Enter")
    problem = field(page, "target.depth_mm").locator(".problem")
    problem.wait_for()
    assert problem.inner_text() == rule
    assert page.input_value("#field-target-depth_mm") == "-3"
    assert page.get_attribute("#field-target-depth_mm", "aria-invalid") == "true"
    page.press("#field-target-depth_mm", "Escape")
    assert page.input_value("#field-target-depth_mm") == "40"
    server.send(people(clients=2), session(seed=3))
    page.wait_for_selector("text=seed 3")
    assert not problem.is_visible()


def test_a_problem_is_left_with_another_state(form, server):
    server.answers["edit"] = Refused(what="edit", reason="no", problems={"target.lateral_mm": "must be less"})
    page = form()
    page.fill("#field-target-depth_mm", "-3")
    page.press("#field-target-depth_mm", "Enter")
    problem = field(page, "target.lateral_mm").locator(".problem")
    problem.wait_for()
    page.locator("#field-target-depth_mm").blur()
    server.send(session(2))
    problem.wait_for(state="hidden")
    until(page, "document.querySelector('#field-target-depth_mm').value === '40'")
    assert page.locator(f"{FORM} .problem:visible").count() == 0


def test_what_is_no_number_is_not_sent(form, server):
    page = form()
    page.fill("#field-target-depth_mm", "deep")
    page.press("#field-target-depth_mm", "Enter")
    page.wait_for_selector("text=must be a number")
    assert not server.asked("edit")
    page.press("#field-target-depth_mm", "Escape")
    assert page.input_value("#field-target-depth_mm") == "40"


def test_a_search_opens_the_sections_of_what_it_finds(form):
    page = form()
    page.fill(f"{FORM} input[type=search]", "flip weight")
    page.wait_for_selector("#field-plan-flip_weight")
    shown = page.locator(f"{FORM} .field[data-key]:visible").evaluate_all(
        "all => all.map((one) => one.dataset.key)"
    )
    assert shown == ["plan.flip_weight"]
    assert "1 setting" in page.inner_text(FORM)


def test_a_layer_is_added_and_removed(form, server):
    page = form()
    page.click("summary:has-text('Layer 1')")
    page.click("[aria-label='Add a layer above layer 1']")
    until(page, "!flexneedle.store.get('draft')")
    layers = server.asked("edit")[-1]["values"]["tissue"]
    assert [layer["name"] for layer in layers] == ["superficial", "superficial", "deep"]
    page.click("[aria-label='Remove layer 1']")
    until(page, "!flexneedle.store.get('draft')")
    layers = server.asked("edit")[-1]["values"]["tissue"]
    assert [layer["name"] for layer in layers] == ["deep"]
    load_scenario("phantom3d").with_values({"tissue": layers})


def test_options_and_doubts(form, server):
    page = form(
        [WELCOME, people(), session(changed=["target.depth_mm"], doubts=["plan.samples = 3: few"]), scene()]
    )
    assert "plan.samples = 3" in page.inner_text(f"{FORM} .doubts")
    page.wait_for_selector(".changed[data-key='target.depth_mm']")
    page.select_option("#option-strategy", "steering")
    page.click("[aria-label='Next seed']")
    page.select_option("#option-controller", "ce-mpc")
    assert server.wait_for("options", 3) == [
        {"type": "options", "strategy": "steering"},
        {"type": "options", "seed": 1},
        {"type": "options", "controller": "ce-mpc"},
    ]


def test_a_seed_that_cannot_be_used_is_reported_and_not_taken(form, server):
    page = form()
    problem = page.locator("#option-seed-problem")
    for text in ("-1", "1.5", "99999999999999999999", ""):
        page.fill("#option-seed", text)
        page.press("#option-seed", "Enter")
        page.press("#option-seed", "Tab")
        problem.filter(has_text="must be a whole number").wait_for()
        page.focus("#option-seed")
    assert page.get_attribute("#option-seed", "aria-invalid") == "true"
    assert not server.asked("options")
    page.fill("#option-seed", "7")
    page.press("#option-seed", "Enter")
    assert server.wait_for("options") == [{"type": "options", "seed": 7}]
    problem.wait_for(state="hidden")
    assert page.get_attribute("#option-seed", "aria-invalid") == "false"


def test_it_cannot_be_changed_while_another_steers(form):
    page = form([WELCOME, people(2, steering=2), session(), scene()])
    until(page, "document.querySelector('#field-target-depth_mm').matches(':disabled')")
    assert (
        page.locator("#option-seed, #option-strategy, #option-controller").evaluate_all(
            "all => all.map((each) => each.matches(':disabled'))"
        )
        == [True] * 3
    )


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(1280, 800), (390, 844)])
def test_it_fits_its_width(form, pictures, size, scheme):
    page = form([*opening(), session()], width=size[0], height=size[1], scheme=scheme)
    page.wait_for_selector("#field-target-depth_mm")
    page.locator("#field-target-depth_mm").focus()
    assert too_wide(page) == []
    pictures(page, f"form-{size[0]}-{scheme}")
