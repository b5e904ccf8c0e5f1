"""The scenario by fields: made from the schema, searched, edited, refused with the problem beside the field."""

import json

import pytest

from browser_checks import arrived, painted
from fake_page import until
from flexneedle.lab.page.protocol import RefusedMessage, SessionMessage
from flexneedle.lab.page.server.catalog import build_catalog
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.sections.environment import ENVIRONMENTS
from recorded_page import WELCOME, clients, scene, scene_frames

pytestmark = pytest.mark.page

FORM = "[data-panel=form]"
DEPTH = "#field-target-depth_mm"
OPEN_ALL = "document.querySelectorAll('details').forEach((each) => { each.open = true; })"


def session(revision=1, changed=(), doubts=(), seed=0, preset="phantom3d", **values):
    flat = load_scenario(preset).flat() | values
    given = {"reach_since": revision, "seed": seed, "strategy": "manipulation", "controller": "adaptive-mpc"}
    return SessionMessage(
        revision=revision, name=preset, values=flat, changed=list(changed), doubts=list(doubts), **given
    )


def field(page, key):
    return page.locator(f"{FORM} [data-key='{key}']")


@pytest.fixture
def form(visit):
    """A function that opens the page with a session and returns it once its form is made."""

    def opened(given=None, **how):
        news = [WELCOME, clients(), given or session(), scene(), *scene_frames()]
        return visit(news, ready=f"{FORM} details", **how)

    return opened


def search(page, text):
    page.fill(f"{FORM} input[type=search]", text)


def enter(page, selector, text):
    page.fill(selector, text)
    page.press(selector, "Enter")


def refuse(server, **problems):
    """Refuse edits with problems by key, none: accept them."""
    server.answers.pop("edit", None)
    if problems:
        server.answers["edit"] = RefusedMessage(what="edit", reason="no", problems=problems)


def edit_of(page, server):
    """The last edit, once it is answered."""
    until(page, "!flexneedle.store.get('draft')")
    return server.asked("edit")[-1]["values"]


FIELDS = """async ([schema, values]) => {
  const { sectionsOf } = await import("/static/form/fields.js");
  return sectionsOf(schema, values).flatMap((section) => section.fields);
}"""


def test_every_value_and_table_of_a_scenario_has_a_field_and_is_found_by_a_search(form):
    """A table has values to begin with; one after the other, since tables contain others."""
    page, scenario, known = form(), load_scenario("phantom3d"), {}
    search(page, ".")  # in all keys and descriptions
    shown = set(page.evaluate("[...document.querySelectorAll('[data-key]')].map((each) => each.dataset.key)"))
    assert set(scenario.flat()) <= shown
    schema = json.loads(build_catalog().schema)
    while True:
        fields = page.evaluate(FIELDS, [schema, scenario.flat()])
        starts = {
            each["key"]: each["start"] for each in fields if "start" in each and each["key"] not in known
        }
        if not starts:
            break
        for key, start in starts.items():
            before, scenario = scenario, scenario.with_values({key: start})
            assert before.with_values({key: None}) == before != scenario
        known |= starts
    optional = {"registration", "environment", "environment.plate"}
    assert set(known) == {f"tracker.{key}" for key in optional} | {"phantom.structure.hidden_layer"}
    labels = {each["key"]: [each["label"], each["unit"]] for each in fields}
    assert labels["tracker.environment.tilt_mrad_per_mm"] == ["Tilt", "mrad/mm"]
    units = {"mm", "mrad", "rad", "deg", "kpa", "gpa", "mn", "mj", "hz", "per"}
    left = {key for key, (label, _) in labels.items() if units & set(label.lower().split())}
    assert left == {"tracker.jitter_per_axis"} & set(labels)
    search(page, "bend weight")
    page.wait_for_selector("#field-plan-bend_weight")
    visible = f"{FORM} .field[data-key]:visible"
    assert page.locator(visible).evaluate_all("all => all.map((one) => one.dataset.key)") == [
        "plan.bend_weight"
    ]
    assert "1 setting" in page.inner_text(FORM)
    shown = f"{FORM} .options input:visible, {FORM} .options select:visible"
    names = "all => all.map((one) => one.id.replace('option-', ''))"
    for text, found in (("unknown seed", []), ("seed", ["seed"]), ("cross", []), ("steering", ["strategy"])):
        search(page, text)
        assert page.locator(shown).evaluate_all(names) == found
        count = len(found) + page.locator(visible).count()
        assert f"{count} setting{'' if count == 1 else 's'}" in page.inner_text(f"{FORM} p[role=status]")
    search(page, "")
    assert page.locator(shown).evaluate_all(names) == ["seed", "strategy", "controller"]


def test_a_value_is_edited_by_keys_and_slider_and_a_refusal_is_beside_it(form, server):
    page = form()
    depth = field(page, "target.depth_mm")
    assert depth.locator("label").inner_text().split("\n")[0].startswith("Depth")
    assert depth.locator(".unit").inner_text() == "mm"
    assert page.get_by_label("Depth in mm").input_value() == "40"
    offset = field(page, "needle.bevel.offset_mm").locator("input[type=range]")
    assert float(offset.get_attribute("min")) == 0.0
    assert float(offset.get_attribute("max")) == pytest.approx(10.0)
    enter(page, DEPTH, "deep")
    page.wait_for_selector("text=must be a number")
    page.press(DEPTH, "Escape")
    assert (page.input_value(DEPTH), server.asked("edit")) == ("40", [])
    rule = "must be at least 0.0 mm"
    refuse(server, **{"target.depth_mm": rule, "target.lateral_mm": "must be less"})
    enter(page, DEPTH, "-3")
    problem = depth.locator(".problem")
    problem.wait_for()
    assert (problem.inner_text(), page.input_value(DEPTH)) == (rule, "-3")
    assert page.get_attribute(DEPTH, "aria-invalid") == "true"
    page.press(DEPTH, "Escape")
    assert page.input_value(DEPTH) == "40"
    page.locator(DEPTH).blur()
    server.send(session(2))
    field(page, "target.lateral_mm").locator(".problem").wait_for(state="hidden")
    assert page.locator(f"{FORM} .problem:visible").count() == 0
    refuse(server)
    enter(page, DEPTH, "35.5")
    assert edit_of(page, server) == {"target.depth_mm": 35.5}
    slider = field(page, "target.lateral_mm").locator("input[type=range]")
    slider.focus()
    slider.press("ArrowRight")
    assert edit_of(page, server).keys() == {"target.lateral_mm"}


def test_a_table_is_set_changed_and_removed(form, server):
    page = form()
    page.evaluate(OPEN_ALL)
    environment = page.locator("#field-tracker-environment")
    assert environment.locator("option").all_text_contents() == [
        "not set",
        *ENVIRONMENTS.names(),
        "own values",
    ]
    environment.select_option("noisy")
    assert edit_of(page, server) == {"tracker.environment": "noisy"}
    choice = page.locator("#field-phantom-structure-hidden_layer")
    assert (choice.input_value(), choice.locator("option").all_text_contents()) == (
        "",
        ["not set", "own values"],
    )
    choice.focus()
    choice.select_option("own values")
    layer = {"top_mm": 10.0, "thickness_mm": 5.0, "modulus_factor": 2.0}
    assert edit_of(page, server) == {"phantom.structure.hidden_layer": layer}
    new = {f"phantom.structure.hidden_layer.{name}": value for name, value in layer.items()}
    server.send(session(2, list(new), **new))
    page.wait_for_selector("details[data-section='phantom.structure.hidden_layer'][open]")
    assert page.evaluate("document.activeElement.id") == "field-phantom-structure-hidden_layer"
    assert choice.input_value() == "own values"
    assert page.locator(f"{FORM} [data-key='phantom.structure.hidden_layer'].changed").count() == 1
    thickness = "#field-phantom-structure-hidden_layer-thickness_mm"
    assert page.input_value(thickness) == "5"
    key = "phantom.structure.hidden_layer.thickness_mm"
    refuse(server, **{key: "must be above 0 mm"})
    enter(page, thickness, "-1")
    field(page, key).locator(".problem").filter(has_text="must be above 0 mm").wait_for()
    assert not field(page, "phantom.structure.hidden_layer").locator(".problem").is_visible()
    refuse(server)
    page.press(thickness, "Escape")
    choice.select_option("not set")
    assert edit_of(page, server) == {"phantom.structure.hidden_layer": None}


def test_a_named_table_keeps_its_values_and_points_are_written_one_after_the_other(form, server):
    points = [[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 100.0, 0.5]]
    noisy = load_scenario("phantom3d").with_values(
        {
            "tracker.environment": "noisy",
            "tracker.environment.tilt_mrad_per_mm": 5.0,
            "tracker.registration": {"fiducials_mm": points},
        }
    )
    page = form(session(**noisy.flat()))
    search(page, "environment")
    choice = page.locator("#field-tracker-environment")
    assert choice.input_value() == "noisy"
    choice.select_option("own values")
    own = noisy.with_values(edit_of(page, server))
    assert own.tracker.environment == noisy.tracker.environment.model_copy(update={"name": "own"})
    server.send(session(2, **own.flat()))
    until(page, "flexneedle.store.get('session').revision === 2")
    painted(page)
    assert choice.input_value() == "own values"
    search(page, "fiducials_mm")
    given = page.locator("#field-tracker-registration-fiducials_mm")
    assert given.input_value() == "0, 0, 0; 100, 0, 0; 0, 100, 0.5"
    problem = field(page, "tracker.registration.fiducials_mm").locator(".problem")
    for missing in ("0 0 0; 50 0; 0, 80, 0", "0, 0, ; 50, 0, 1; 0, 80, 0", "0 0 0;; 50 0 0; 0 80 0"):
        given.fill(missing)
        given.press("Enter")
        assert problem.inner_text() == "must be points x, y, z, separated by semicolons"
    given.fill("0 0 0; 50 0 −1; 0, 80, 0;")
    given.press("Enter")
    wanted = {"tracker.registration.fiducials_mm": [[0, 0, 0], [50, 0, -1], [0, 80, 0]]}
    assert edit_of(page, server) == wanted


def test_layers_are_added_removed_and_get_another_or_a_custom_law(form, server):
    """A layer with another law keeps the values that both laws have; a custom law could not be set again."""
    page, before = form(), load_scenario("phantom3d")
    page.locator("details[data-section='tissue.0'] > summary").click()
    page.get_by_role("button", name="Add a layer above layer 1").click()
    added = before.with_values(edit_of(page, server))
    assert [layer.name for layer in added.tissue] == ["superficial", "superficial", "deep"]
    server.send(session(2, **added.flat()))
    page.wait_for_selector("details[data-section='tissue.2']")
    opened = page.locator(f"{FORM} .sections > details[open]")
    assert "tissue.2" not in opened.evaluate_all("all => all.map((each) => each.dataset.section)")
    page.click("[aria-label='Remove layer 1']")
    assert [layer["name"] for layer in edit_of(page, server)["tissue"]] == ["superficial", "deep"]
    server.send(session(3))
    page.wait_for_selector("details[data-section='tissue.2']", state="detached")
    page.evaluate(OPEN_ALL)
    page.locator("#field-tissue-1-law").select_option("linear")
    linear = before.with_values(edit_of(page, server))
    assert [layer.law for layer in linear.tissue] == ["ogden", "linear"]
    assert linear.tissue[0] == before.tissue[0]
    assert linear.tissue[1].shear_modulus_kpa == before.tissue[1].shear_modulus_kpa
    server.send(session(4).model_copy(update={"values": linear.flat()}))
    page.wait_for_selector("#field-tissue-1-alpha", state="detached")
    page.locator("#field-tissue-1-law").select_option("ogden")
    again = linear.with_values(edit_of(page, server))
    assert again.tissue[1].alpha == 8.74
    assert again.tissue[1].model_copy(update={"alpha": before.tissue[1].alpha}) == before.tissue[1]
    page.locator("#field-tissue-1-law").select_option("tearing")
    assert linear.with_values(edit_of(page, server)).tissue[1].yield_mm == 0.5
    given = session(5, **{"tissue.1.law": "mine:Law", "tissue.1.yield_kpa": 3.0, "tissue.1.hardens": True})
    del given.values["tissue.1.alpha"]
    server.send(given)
    until(page, "flexneedle.store.get('session').revision === 5")
    painted(page)
    search(page, "tissue.1.")
    keys = page.evaluate(
        "[...document.querySelectorAll('[data-key^=\"tissue.1.\"]')].map((one) => one.dataset.key)"
    )
    assert set(keys) >= {key for key in given.values if key.startswith("tissue.1.")}
    assert "tissue.1.alpha" not in keys
    assert page.locator("#field-tissue-1-law option").all_text_contents() == ["mine:Law"]
    assert page.input_value("#field-tissue-1-yield_kpa") == "3"
    assert page.is_checked("#field-tissue-1-hardens")


def test_a_refused_choice_stays_with_the_problem_of_its_part_and_others_follow_the_scenario(form, server):
    """The part has no field yet."""
    linear = session(**{"tissue.1.law": "linear"})
    del linear.values["tissue.1.alpha"]
    page = form(linear)
    for key, chosen, part in (
        ("phantom.structure.hidden_layer", "own values", "phantom.structure.hidden_layer.top_mm"),
        ("tissue.1.law", "ogden", "tissue.1.alpha"),
    ):
        refuse(server, **{part: "must be at most 5"})
        search(page, key)
        choice = field(page, key).locator("select")
        choice.focus()
        choice.select_option(chosen)
        problem = field(page, key).locator(".problem")
        problem.wait_for()
        assert problem.inner_text() == f"{part.split('.')[-1]}: must be at most 5"
        assert choice.input_value() == chosen
    refuse(server)
    search(page, "setup.rotation")
    choice = page.locator("#field-setup-rotation")
    before = choice.input_value()
    other = next(each for each in choice.locator("option").all_text_contents() if each != before)
    choice.focus()
    server.send(session(2, **{"setup.rotation": other}))
    until(page, "flexneedle.store.get('session').revision === 2")
    painted(page)
    assert (choice.input_value(), page.evaluate("document.activeElement.id")) == (
        other,
        "field-setup-rotation",
    )


RECONNECTED = """(welcome) => {
  const [made, other] = ["target", "tissue.1"].map((name) => document.querySelector(`details[data-section='${name}']`));
  const toggled = (section) => new Promise((resolve) => section.addEventListener("toggle", resolve));
  const both = Promise.all([toggled(made), toggled(other)]);
  flexneedle.store.receive(JSON.parse(welcome));
  [made.open, other.open] = [false, true];
  return both;
}"""
"""Close and open sections after the first message of a new connection, before its session has arrived."""


def test_another_connection_sends_its_session_options_are_chosen_and_all_is_disabled_without_control(
    form, server
):
    """The browser reports an opened section later, and the first message of the connection may precede it."""
    page = form()
    page.evaluate(RECONNECTED, WELCOME.model_dump_json())
    assert page.evaluate("flexneedle.store.get('session')") is None
    assert page.locator("#field-tissue-1-law").input_value() == "ogden"
    server.send(
        clients(), session(3, ["target.depth_mm"], ["plan.samples = 3: few"], **{"tissue.1.alpha": 7.5})
    )
    until(page, "document.querySelector('#field-tissue-1-alpha').value === '7.5'")
    assert "plan.samples = 3" in page.inner_text(f"{FORM} .doubts")
    page.wait_for_selector(".changed[data-key='target.depth_mm']", state="attached")
    problem = page.locator("#option-seed-problem")
    for text in ("-1", "1.5", "99999999999999999999", ""):
        enter(page, "#option-seed", text)
        problem.filter(has_text="must be a whole number").wait_for()
    assert page.get_attribute("#option-seed", "aria-invalid") == "true"
    assert not server.asked("options")
    enter(page, "#option-seed", "7")
    problem.wait_for(state="hidden")
    page.select_option("#option-strategy", "steering")
    page.select_option("#option-controller", "ce-mpc")
    server.wait_for("options", 3)
    arrived(page)
    next_seed = page.locator("[aria-label='Next seed']")
    next_seed.evaluate("(button) => { for (let each = 0; each < 2; each += 1) button.click(); }")  # fast
    assert server.wait_for("options", 5) == [
        {"type": "options", "seed": 7},
        {"type": "options", "strategy": "steering"},
        {"type": "options", "controller": "ce-mpc"},
        {"type": "options", "seed": 1},
        {"type": "options", "seed": 2},
    ]
    server.send(clients(2, steering=2))
    until(page, f"document.querySelector('{DEPTH}').matches(':disabled')")
    disabled = "all => all.map((each) => each.matches(':disabled'))"
    options = page.locator("#option-seed, #option-strategy, #option-controller")
    assert options.evaluate_all(disabled) == [True] * 3
