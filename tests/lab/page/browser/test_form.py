"""The scenario by fields: made from the schema, searched, refused with the problem beside the field."""

import json

import pytest

from browser_layout import too_wide
from fake_page import until
from flexneedle.lab.page.protocol import RefusedMessage, SessionMessage
from flexneedle.lab.page.server.catalog import build_catalog
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.sections.environment import ENVIRONMENTS
from recorded_page import WELCOME, opening, people, scene, scene_frames

pytestmark = pytest.mark.page

FORM = "[data-panel=form]"


def session(revision=1, changed=(), doubts=(), seed=0, preset="phantom3d", **values):
    flat = load_scenario(preset).flat() | values
    given = {"reach_since": revision, "seed": seed, "strategy": "manipulation", "controller": "adaptive-mpc"}
    return SessionMessage(
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
    assert values <= shown


FIELDS = """async ([schema, values]) => {
  const { sectionsOf } = await import("/static/form/fields.js");
  return sectionsOf(schema, values).flatMap((section) => section.fields);
}"""


def test_every_table_that_may_be_set_has_a_field_with_values_to_begin_with(form):
    """One after the other, since tables have others inside; the field shows which it is, and takes it back."""
    page, scenario, seen = form(), load_scenario("phantom3d"), {}
    while True:
        fields = page.evaluate(FIELDS, [json.loads(build_catalog().schema), scenario.flat()])
        starts = {
            each["key"]: each["start"] for each in fields if "start" in each and each["key"] not in seen
        }
        if not starts:
            break
        for key, start in starts.items():
            before, scenario = scenario, scenario.with_values({key: start})
            assert before.with_values({key: None}) == before != scenario
        seen |= starts
    optional = {"registration", "environment", "environment.plate"}
    assert set(seen) == {f"tracker.{key}" for key in optional} | {"phantom.structure.hidden_layer"}


def test_a_table_is_set_changed_and_taken_away(form, server):
    page = form()
    page.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    choice = page.locator("#field-phantom-structure-hidden_layer")
    assert (choice.input_value(), choice.locator("option").all_text_contents()) == (
        "",
        ["not set", "own values"],
    )
    choice.focus()
    choice.select_option("own values")
    server.wait_for("edit")
    layer = {"top_mm": 10.0, "thickness_mm": 5.0, "modulus_factor": 2.0}
    assert server.asked("edit")[-1]["values"] == {"phantom.structure.hidden_layer": layer}
    new = {f"phantom.structure.hidden_layer.{name}": value for name, value in layer.items()}
    server.send(session(2, list(new), **new))
    page.wait_for_selector("details[data-section='phantom.structure.hidden_layer'][open]")  # it is in sight
    assert page.evaluate("document.activeElement.id") == "field-phantom-structure-hidden_layer"
    assert choice.input_value() == "own values"
    changed = page.locator(f"{FORM} [data-key='phantom.structure.hidden_layer'].changed")
    assert changed.count() == 1
    assert page.locator("#field-phantom-structure-hidden_layer-thickness_mm").input_value() == "5"
    choice.select_option("not set")
    until(page, "!flexneedle.store.get('draft')")
    assert server.asked("edit")[-1]["values"] == {"phantom.structure.hidden_layer": None}


def test_a_layer_gets_another_law_and_keeps_what_both_have(form, server):
    page = form()
    page.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    page.locator("#field-tissue-1-law").select_option("linear")
    server.wait_for("edit")
    values = server.asked("edit")[-1]["values"]
    before = load_scenario("phantom3d")
    linear = before.with_values(values)
    assert [layer.law for layer in linear.tissue] == ["ogden", "linear"]
    assert linear.tissue[0] == before.tissue[0]
    assert linear.tissue[1].shear_modulus_kpa == before.tissue[1].shear_modulus_kpa
    server.send(session(2, **linear.flat()).model_copy(update={"values": linear.flat()}))
    page.wait_for_selector("#field-tissue-1-alpha", state="detached")
    page.locator("#field-tissue-1-law").select_option("ogden")
    until(page, "!flexneedle.store.get('draft')")
    again = linear.with_values(server.asked("edit")[-1]["values"])
    assert again.tissue[1].alpha == 8.74
    assert again.tissue[1].model_copy(update={"alpha": before.tissue[1].alpha}) == before.tissue[1]


def test_a_named_table_keeps_its_values_as_own_ones(form, server):
    noisy = load_scenario("phantom3d").with_values(
        {"tracker.environment": "noisy", "tracker.environment.tilt_mrad_per_mm": 5.0}
    )
    page = form([WELCOME, people(), session(**noisy.flat()), scene(), *scene_frames()])
    page.fill(f"{FORM} input[type=search]", "environment")
    choice = page.locator("#field-tracker-environment")
    assert choice.input_value() == "noisy"
    choice.select_option("own values")
    server.wait_for("edit")
    own = noisy.with_values(server.asked("edit")[-1]["values"])
    environment = noisy.tracker.environment.model_copy(update={"name": "own"})
    assert own.tracker.environment == environment
    server.send(session(2, **own.flat()))
    until(page, "flexneedle.store.get('session').revision === 2")
    until(page, "document.querySelector('#field-tracker-environment').value === 'own values'")


def test_a_layer_with_a_law_of_its_own_has_fields_for_its_values(form):
    """Its law is not changed here: it could not be set again."""
    own = {"tissue.1.law": "mine:Law", "tissue.1.yield_kpa": 3.0, "tissue.1.hardens": True}
    given = session(**own)
    del given.values["tissue.1.alpha"]
    page = form([WELCOME, people(), given, scene(), *scene_frames()])
    page.fill(f"{FORM} input[type=search]", "tissue.1.")
    keys = page.evaluate(
        "[...document.querySelectorAll('[data-key^=\"tissue.1.\"]')].map((each) => each.dataset.key)"
    )
    assert set(keys) >= {key for key in given.values if key.startswith("tissue.1.")}
    assert "tissue.1.alpha" not in keys
    law = page.locator("#field-tissue-1-law")
    assert law.locator("option").all_text_contents() == ["mine:Law"]
    assert page.locator("#field-tissue-1-yield_kpa").input_value() == "3"
    assert page.locator("#field-tissue-1-hardens").is_checked()


@pytest.mark.parametrize(
    ("key", "chosen", "part"),
    [
        ("phantom.structure.hidden_layer", "own values", "phantom.structure.hidden_layer.top_mm"),
        ("tissue.1.law", "ogden", "tissue.1.alpha"),
    ],
)
def test_a_choice_that_is_refused_stays_with_the_problem_of_its_part(form, server, key, chosen, part):
    """Of a part that has no field yet."""
    server.answers["edit"] = RefusedMessage(what="edit", reason="no", problems={part: "must be at most 5"})
    linear = session(**{"tissue.1.law": "linear"})
    del linear.values["tissue.1.alpha"]
    page = form([WELCOME, people(), linear, scene(), *scene_frames()])
    page.fill(f"{FORM} input[type=search]", key)
    choice = field(page, key).locator("select")
    choice.focus()
    choice.select_option(chosen)
    problem = field(page, key).locator(".problem")
    problem.wait_for()
    assert problem.inner_text() == f"{part.split('.')[-1]}: must be at most 5"
    assert choice.input_value() == chosen


def test_a_problem_of_a_field_is_not_shown_at_its_table_too(form, server):
    values = {"phantom.structure.hidden_layer": {"top_mm": 10.0, "thickness_mm": 5.0, "modulus_factor": 2.0}}
    hidden = load_scenario("phantom3d").with_values(values)
    key = "phantom.structure.hidden_layer.thickness_mm"
    server.answers["edit"] = RefusedMessage(what="edit", reason="no", problems={key: "must be above 0 mm"})
    page = form([WELCOME, people(), session(**hidden.flat()), scene(), *scene_frames()])
    page.fill(f"{FORM} input[type=search]", "hidden_layer")
    page.fill("#field-phantom-structure-hidden_layer-thickness_mm", "-1")
    page.press("#field-phantom-structure-hidden_layer-thickness_mm", "Enter")
    problem = field(page, key).locator(".problem")
    problem.wait_for()
    assert problem.inner_text() == "must be above 0 mm"
    assert not field(page, "phantom.structure.hidden_layer").locator(".problem").is_visible()


def test_a_choice_that_has_the_focus_follows_the_scenario(form, server):
    """Another person has changed it, or the edit has come to nothing: nothing is being written in it."""
    page = form()
    page.fill(f"{FORM} input[type=search]", "setup.rotation")
    choice = page.locator("#field-setup-rotation")
    before = choice.input_value()
    other = next(each for each in choice.locator("option").all_text_contents() if each != before)
    choice.focus()
    server.send(session(2, **{"setup.rotation": other}))
    until(page, "flexneedle.store.get('session').revision === 2")
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    assert (choice.input_value(), page.evaluate("document.activeElement.id")) == (
        other,
        "field-setup-rotation",
    )


def test_a_layer_that_is_added_opens_no_other(form, server):
    page = form()
    page.locator("details[data-section='tissue.0'] > summary").click()
    page.get_by_role("button", name="Add a layer above layer 1").click()
    server.wait_for("edit")
    added = load_scenario("phantom3d").with_values(server.asked("edit")[-1]["values"])
    assert len(added.tissue) == 3
    server.send(session(2, **added.flat()))
    page.wait_for_selector("details[data-section='tissue.2']")
    opened = page.locator(f"{FORM} .sections > details[open]")
    assert "tissue.2" not in opened.evaluate_all("all => all.map((each) => each.dataset.section)")


def test_points_are_written_and_read_one_after_the_other(form, server):
    points = [[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 100.0, 0.5]]
    values = load_scenario("phantom3d").with_values({"tracker.registration": {"fiducials_mm": points}}).flat()
    page = form([WELCOME, people(), session(**values), scene(), *scene_frames()])
    page.fill(f"{FORM} input[type=search]", "fiducials_mm")
    given = page.locator("#field-tracker-registration-fiducials_mm")
    assert given.input_value() == "0, 0, 0; 100, 0, 0; 0, 100, 0.5"
    given.fill("0 0 0; 50 0; 0, 80, 0")
    given.press("Enter")
    problem = field(page, "tracker.registration.fiducials_mm").locator(".problem")
    assert problem.inner_text() == "must be points x, y, z, separated by semicolons"
    for missing in ("0, 0, ; 50, 0, 1; 0, 80, 0", "0 0 0;; 50 0 0; 0 80 0"):  # an empty part is no 0
        given.fill(missing)
        given.press("Enter")
        assert problem.inner_text() == "must be points x, y, z, separated by semicolons"
    given.fill("0 0 0; 50 0 −1; 0, 80, 0;")
    given.press("Enter")
    until(page, "!flexneedle.store.get('draft')")
    assert server.asked("edit")[-1]["values"] == {
        "tracker.registration.fiducials_mm": [[0, 0, 0], [50, 0, -1], [0, 80, 0]]
    }


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
    server.answers["edit"] = RefusedMessage(what="edit", reason="no", problems={"target.depth_mm": rule})
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
    server.answers["edit"] = RefusedMessage(
        what="edit", reason="no", problems={"target.lateral_mm": "must be less"}
    )
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


@pytest.mark.parametrize(
    ("text", "found"), [("unknown seed", []), ("seed", ["seed"]), ("cross", []), ("steering", ["strategy"])]
)
def test_a_search_finds_the_options_too(form, text, found):
    """By their names and choices."""
    page = form()
    shown = f"{FORM} .options input:visible, {FORM} .options select:visible"
    names = "all => all.map((one) => one.id.replace('option-', ''))"
    page.fill(f"{FORM} input[type=search]", text)
    settings = page.locator(f"{FORM} .field[data-key]:visible").count()
    assert page.locator(shown).evaluate_all(names) == found
    count = len(found) + settings
    assert f"{count} setting{'' if count == 1 else 's'}" in page.inner_text(f"{FORM} p[role=status]")
    page.fill(f"{FORM} input[type=search]", "")
    assert page.locator(shown).evaluate_all(names) == ["seed", "strategy", "controller"]


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


def test_no_unit_is_left_in_a_label(form):
    noisy = load_scenario("phantom3d").with_values({"tracker.environment": "noisy"})
    fields = form().evaluate(FIELDS, [json.loads(build_catalog().schema), noisy.flat()])
    labels = {each["key"]: [each["label"], each["unit"]] for each in fields}
    assert labels["tracker.environment.tilt_mrad_per_mm"] == ["Tilt", "mrad/mm"]
    units = {"mm", "mrad", "rad", "deg", "kpa", "gpa", "mn", "mj", "hz", "per"}
    left = {key for key, (label, _) in labels.items() if units & set(label.lower().split())}
    assert left == {"tracker.jitter_per_axis"} & set(labels)


def test_a_tracker_without_an_environment_may_be_given_a_shipped_one(form, server):
    """In which a metal plate distorts the field; its values have fields of their own from then on."""
    assert ENVIRONMENTS.names() == ["ideal", "noisy"]
    page = form()
    page.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    choice = page.locator("#field-tracker-environment")
    assert choice.locator("option").all_text_contents() == ["not set", *ENVIRONMENTS.names(), "own values"]
    choice.select_option("noisy")
    server.wait_for("edit")
    assert server.asked("edit")[-1]["values"] == {"tracker.environment": "noisy"}


@pytest.mark.parametrize("width", [1280, 390])
def test_labels_are_readable(form, width):
    """No word of a label is broken, beside the widest value as well."""
    page = form(width=width, height=900)
    page.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    broken = page.evaluate(
        """() => [...document.querySelectorAll('.field > label')].filter((label) => {
          const range = document.createRange();
          return label.firstChild.data.split(' ').some((word) => {
            const begin = label.firstChild.data.indexOf(word);
            range.setStart(label.firstChild, begin);
            range.setEnd(label.firstChild, begin + word.length);
            return range.getClientRects().length > 1;
          });
        }).map((label) => label.textContent)"""
    )
    assert broken == []
