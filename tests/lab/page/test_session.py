"""The session: edits, presets, files, options."""

import json
import tomllib

import pytest

from flexneedle.lab.page.protocol import NamedTarget
from flexneedle.lab.page.requests import OptionsRequest, RestoreRequest, TargetsRequest
from flexneedle.lab.page.server.clients import Refusal
from flexneedle.lab.page.server.page_session import PageSession
from flexneedle.scenario.files import dump_scenario, load_scenario
from flexneedle.scenario.sections.needle import GAUGES
from page_clients import restored


@pytest.fixture
def session():
    return PageSession.of("phantom", load_scenario("phantom"))


def test_an_edit_changes_values_by_key_and_none_returns_to_the_default(session):
    edited = session.edit_scenario({"target.depth_mm": 35.0, "tissue.0.alpha": 9.0, "target.lateral_mm": 3.0})
    assert edited.revision == session.revision + 1
    assert edited.scenario.target.depth_mm == 35.0
    message = edited.edit_scenario({"target.lateral_mm": None}).describe()
    assert message.changed == ["tissue.0.alpha", "target.depth_mm"]
    assert (message.values["tissue.0.alpha"], message.values["target.lateral_mm"]) == (9.0, 5.0)


@pytest.mark.parametrize(
    ("change", "stays"),
    [
        (lambda one: one.edit_scenario({"target.depth_mm": 35.0, "target.lateral_mm": -3.0}), True),
        (lambda one: one.edit_scenario({"target.depth_mm": 35.0, "tissue.0.alpha": 9.0}), False),
        (lambda one: one.with_options(OptionsRequest(type="options", controller="ce-mpc")), True),
        (lambda one: one.with_options(OptionsRequest(type="options", seed=3)), False),
        (lambda one: one.with_options(OptionsRequest(type="options", strategy="steering")), False),
        (lambda one: one.with_preset("phantom"), False),
    ],
)
def test_a_reach_stays_while_only_target_and_controller_have_changed(session, change, stays):
    before = session.edit_scenario({"needle.outer_diameter_mm": 0.9})
    assert before.reach_since == before.revision
    after = change(before)
    assert after.describe().reach_since == (before.revision if stays else after.revision)


@pytest.mark.parametrize("gauge", ["18G", "25G"])
def test_gauge_and_diameters_of_a_needle_replace_each_other(session, gauge):
    """The scenario refuses one beside the other: each would have to be cleared before."""
    by_gauge = session.edit_scenario({"needle.gauge": gauge})
    needle = by_gauge.scenario.needle
    assert (needle.gauge, needle.outer_diameter_mm, needle.inner_diameter_mm) == (gauge, None, None)
    assert by_gauge.edit_scenario({"needle.gauge": "21G"}).scenario.needle.gauge == "21G"
    known = dict(zip(("outer_diameter_mm", "inner_diameter_mm"), GAUGES[gauge], strict=True))
    for changed in ({"gauge": None}, {"outer_diameter_mm": 1.5}, {"inner_diameter_mm": 0.1}):
        needle = by_gauge.edit_scenario(
            {f"needle.{key}": value for key, value in changed.items()}
        ).scenario.needle
        expected = {"gauge": None} | known | changed
        assert {key: getattr(needle, key) for key in expected} == expected
    for other in ({"needle.stylet": True}, {"needle.inner_diameter_mm": None}):
        assert by_gauge.edit_scenario(other).scenario.needle.gauge == gauge


NUMBER = [float("nan"), float("inf"), 10**400, "5", [], {}, {"a": [{}]}, [[1.0]], True]
KEYS = [
    "nonsense",
    "needle.nonsense",
    "tissue.9.alpha",
    "tissue.999999999999999999999.alpha",
    "name.x",
    ".",
    "a..b",
]
EDITS = [
    *(({key: 1.0}, set()) for key in KEYS),
    *(({"target.depth_mm": value}, set()) for value in NUMBER),
    ({"target.depth_mm": 1000.0}, {"target.depth_mm"}),  # a rule between sections
    (
        {"needle.youngs_modulus_gpa": -1, "tissue.1.alpha": "x", "target.depth_mm": 35.0},
        {"needle.youngs_modulus_gpa", "tissue.1.alpha"},
    ),
]


def test_a_wrong_edit_is_refused_with_all_problems_by_key(session):
    for values, keys in EDITS:
        with pytest.raises(Refusal) as refused:
            session.edit_scenario(values)
        assert keys <= refused.value.problems.keys(), values
    assert set(refused.value.problems.values()) == {"must be above 0", "must be a number"}


def test_implausible_values_are_doubts(session):
    doubts = session.edit_scenario({"needle.youngs_modulus_gpa": 20_000}).describe().doubts
    assert any("youngs_modulus" in line for line in doubts)


def test_a_zone_whose_file_is_missing_is_a_doubt_of_a_loaded_file_and_of_an_edit(session):
    """It is not refused: an edit may leave the zone out."""
    zone = {"shape": "file", "name": "artery", "file": "/nowhere/artery.stl"}
    zoned = session.scenario.with_values({"zone": [zone], "image.sd_mm": 0.3})
    loaded = session.with_file("case.toml", dump_scenario(zoned))
    edited = session.edit_scenario({"zone": [zone], "image.sd_mm": 0.3})
    for found in (loaded, edited):
        (line,) = found.describe().doubts
        assert line.startswith("zone artery: /nowhere/artery.stl: cannot be read")


def test_a_preset_or_world_begins_a_new_scenario(session, tmp_path, monkeypatch):
    begun = session.edit_scenario({"target.depth_mm": 35.0}).with_preset("phantom3d")
    assert (begun.describe().changed, begun.name) == ([], "phantom3d")
    assert begun.revision == session.revision + 2
    for world in ("world:7", "wide:7:structure"):
        assert session.with_preset(world).scenario == load_scenario(world)
    for file in ("case", "case.toml"):
        (tmp_path / file).write_text(dump_scenario(session.scenario))
    monkeypatch.chdir(tmp_path)
    for name in ("case", "case.toml", "../case.toml", "world:x", "wide:7:nonsense"):
        with pytest.raises(Refusal):
            session.with_preset(name)


def test_a_file_is_loaded(session, minimal_text):
    loaded = session.with_file("mine", minimal_text)
    assert (loaded.name, loaded.scenario.name, loaded.describe().changed) == ("mine", "Minimal", [])
    assert session.with_file("mine", dump_scenario(session.scenario)).scenario == session.scenario
    for text in ("[", "\x00", 'name = "x"', "a = " + "[" * 50_000, "needle = 1"):
        with pytest.raises(Refusal):
            session.with_file("mine", text)


def test_a_file_of_another_program_is_refused_briefly(session):
    with pytest.raises(Refusal) as refusal:
        session.with_file("other.toml", "\n".join(f"key_{number} = 1" for number in range(40)))
    assert refusal.value.reason.startswith("other.toml: name: missing; ")
    assert refusal.value.reason.endswith(" more")
    assert len(refusal.value.reason) < 100
    assert refusal.value.problems["key_7"].startswith("unknown key")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (".".join(["a"] * 90_000) + " = 1", "89999 dots in a line"),
        ('"\u2028".' * 20_000 + "a = 1", "20000 dots in a line"),  # for str.splitlines an end of line
        ("\n".join(f"k{number}=1" for number in range(30_000)), "30000 keys and tables"),
        ("\n".join(f"[t{number}]" for number in range(20_000)), "20000 keys and tables"),
        ("a = {" + ", ".join(f"k{number}=1" for number in range(20_000)) + "}", "20001 keys and tables"),
    ],
)
def test_a_file_that_takes_long_to_read_is_refused_before(session, monkeypatch, text, reason):
    monkeypatch.delattr(tomllib, "loads")  # minutes and much memory
    with pytest.raises(Refusal, match=f"^mine: {reason}: "):
        session.with_file("mine", text)


def test_options_that_are_not_set_stay(session):
    changed = session.with_options(OptionsRequest(type="options", seed=7))
    assert (changed.seed, changed.strategy, changed.controller) == (7, "manipulation", "")
    assert changed.revision == session.revision + 1


def given_back(session):
    """The request with which a page gives a session back."""
    values = restored(session.describe().model_dump(mode="json"))
    return RestoreRequest.model_validate_json(
        json.dumps(values | {"type": "restore", "controller": "ce-mpc"})
    )


@pytest.mark.parametrize("name", ["phantom", "phantom3d", "world:7", "wide:100012"])
def test_a_session_is_restored_from_its_message(session, name):
    lost = session.with_preset(name).edit_scenario({"target.depth_mm": 33.0, "tissue.0.alpha": 9.0})
    lost = lost.with_targets(TargetsRequest(type="targets", what="add", name="Deep"))
    lost = lost.with_options(OptionsRequest(type="options", seed=3, strategy="steering", controller="ce-mpc"))
    found = session.restore(given_back(lost))
    assert found.has_content_of(lost)
    assert found.revision == session.revision + 1
    assert found.describe().changed == ["tissue.0.alpha", "target.depth_mm"]


@pytest.mark.parametrize(("names", "active"), [(["A", "A"], "A"), (["A", "B"], "C"), ([], "A")])
def test_targets_with_equal_names_or_without_the_active_one_are_not_restored(session, names, active):
    targets = [NamedTarget(name=name, position=(30.0, 0.0, 0.0)) for name in names]
    with pytest.raises(Refusal, match="must have different names"):
        session.restore(given_back(session).model_copy(update={"targets": targets, "target": active}))


def changed(session, what, name=None):
    return session.with_targets(TargetsRequest(type="targets", what=what, name=name))


def described(session):
    """Name of the active target, and depths by name."""
    found = session.describe()
    assert (
        found.values["target.depth_mm"] == {one.name: one.position for one in found.targets}[found.target][0]
    )
    return found.target, {one.name: one.position[0] for one in found.targets}


def test_targets_are_added_chosen_and_removed_and_one_is_the_scenarios(session):
    assert described(session) == ("Target 1", {"Target 1": 40.0})
    assert session.target_name == ""
    two = changed(session, "add").edit_scenario({"target.depth_mm": 30.0, "target.lateral_mm": 2.0})
    assert described(two) == ("Target 2", {"Target 1": 40.0, "Target 2": 30.0})
    assert two.target_name == "Target 2"
    three = changed(two, "add", "Near").edit_scenario({"target.depth_mm": 20.0})
    back = changed(three, "choose", "Target 1")
    assert described(back) == ("Target 1", {"Target 1": 40.0, "Target 2": 30.0, "Near": 20.0})
    assert back.scenario == session.scenario
    assert back.reach_since == session.reach_since
    assert changed(back, "choose", "Target 2").scenario == two.scenario
    left = changed(back, "remove", "Target 2")
    assert described(left) == ("Target 1", {"Target 1": 40.0, "Near": 20.0})
    assert described(changed(left, "add"))[0] == "Target 2"
    assert described(back.with_preset("phantom3d")) == ("Target 1", {"Target 1": 40.0})


@pytest.mark.parametrize(
    ("what", "name", "reason"),
    [
        ("add", "Target 1", "Target 1: there is already a target of this name: choose another"),
        ("choose", "Far", "target = Far: must be one of Target 1, Near"),
        ("remove", "Far", "target = Far: must be one of Target 1, Near"),
        ("remove", "Near", "Near is the target of the scenario: choose another one first"),
    ],
)
def test_changes_of_targets_are_refused_with_their_reason(session, what, name, reason):
    with pytest.raises(Refusal) as refusal:
        changed(changed(session, "add", "Near"), what, name)
    assert refusal.value.reason == reason


def test_the_number_of_targets_is_limited_and_a_target_off_the_plane_is_refused(session):
    many = session
    for _ in range(49):
        many = changed(many, "add")
    with pytest.raises(Refusal, match="there are 50 targets"):
        changed(many, "add")
    space = changed(session.with_preset("phantom3d"), "add").edit_scenario({"target.lateral_z_mm": 3.0})
    plane = changed(space, "choose", "Target 1").edit_scenario({"setup.axes": 1, "target.lateral_z_mm": 0.0})
    with pytest.raises(Refusal) as refusal:
        changed(plane, "choose", "Target 2")
    assert "target.lateral_z_mm" in refusal.value.problems


def test_a_restored_file_is_compared_with_the_file_where_the_server_has_it(session, minimal_text):
    file = PageSession.of("mine", session.with_file("mine", minimal_text).scenario)
    lost = file.edit_scenario({"target.depth_mm": 33.0})
    assert file.restore(given_back(lost)).describe().changed == ["target.depth_mm"]
    elsewhere = session.restore(given_back(lost))
    assert (elsewhere.scenario, elsewhere.describe().changed) == (lost.scenario, [])


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"target.depth_mm": -1.0}, "target.depth_mm"),
        ({"target.depth": 30.0}, "target.depth"),
        ({"name.x": 1}, "name.x"),
        ({"tissue.7.alpha": 1.0}, "tissue"),
    ],
)
def test_an_invalid_session_is_not_restored(session, change, problem):
    request = given_back(session)
    with pytest.raises(Refusal) as refusal:
        session.restore(request.model_copy(update={"values": request.values | change}))
    assert refusal.value.reason.startswith("phantom: ")
    assert problem in refusal.value.problems, refusal.value.problems
