"""The session: edits, presets, files, options."""

import tomllib

import pytest

from flexneedle.lab.page.requests import OptionsRequest
from flexneedle.lab.page.server.clients import Refusal
from flexneedle.lab.page.server.page_session import PageSession
from flexneedle.scenario.files import dump_scenario, load_scenario
from flexneedle.scenario.sections.needle import GAUGES


@pytest.fixture
def session():
    return PageSession.of("phantom", load_scenario("phantom"))


def test_an_edit_changes_values_by_key(session):
    edited = session.edited({"target.depth_mm": 35.0, "tissue.0.alpha": 9.0})
    assert edited.revision == session.revision + 1
    assert edited.scenario.target.depth_mm == 35.0
    news = edited.describe()
    assert news.changed == ["tissue.0.alpha", "target.depth_mm"]
    assert news.values["tissue.0.alpha"] == 9.0


@pytest.mark.parametrize(
    ("values", "stays"),
    [
        ({"target.depth_mm": 35.0, "target.lateral_mm": -3.0}, True),
        ({"tissue.0.alpha": 9.0}, False),
        ({"target.depth_mm": 35.0, "tissue.0.alpha": 9.0}, False),
    ],
)
def test_a_reach_stays_while_only_the_target_has_changed(session, values, stays):
    before = session.edited({"needle.outer_diameter_mm": 0.9})
    assert before.reach_since == before.revision
    after = before.edited(values)
    assert after.describe().reach_since == (before.revision if stays else after.revision)


@pytest.mark.parametrize(
    ("option", "stays"),
    [({"controller": "ce-mpc"}, True), ({"seed": 3}, False), ({"strategy": "steering"}, False)],
)
def test_a_reach_is_of_a_seed_and_a_strategy(session, option, stays):
    after = session.with_options(OptionsRequest(type="options", **option))
    assert after.reach_since == (session.revision if stays else after.revision)


def test_no_reach_stays_when_a_preset_begins_anew(session):
    assert session.with_preset("phantom").reach_since == session.revision + 1


@pytest.mark.parametrize("gauge", ["18G", "25G"])
def test_gauge_and_diameters_of_a_needle_take_each_others_place(session, gauge):
    """An edit of one is refused beside the other: each would have to be cleared before."""
    by_gauge = session.edited({"needle.gauge": gauge})
    needle = by_gauge.scenario.needle
    assert (needle.gauge, needle.outer_diameter_mm, needle.inner_diameter_mm) == (gauge, None, None)
    assert by_gauge.edited({"needle.gauge": "21G"}).scenario.needle.gauge == "21G"
    for values in (
        {"needle.gauge": None},
        {"needle.outer_diameter_mm": 1.5},
        {"needle.inner_diameter_mm": 0.1},
    ):
        needle = by_gauge.edited(values).scenario.needle
        outer, inner = GAUGES[gauge]
        expected = {"outer_diameter_mm": outer, "inner_diameter_mm": inner}
        expected |= {key.split(".")[1]: value for key, value in values.items() if value is not None}
        assert needle.gauge is None
        assert {key: getattr(needle, key) for key in expected} == expected
    assert by_gauge.edited({"needle.stylet": True}).scenario.needle.gauge == gauge
    assert by_gauge.edited({"needle.inner_diameter_mm": None}).scenario.needle.gauge == gauge


def test_none_returns_a_value_to_its_default(session):
    edited = session.edited({"target.lateral_mm": 3.0})
    assert edited.edited({"target.lateral_mm": None}).scenario.target.lateral_mm == 5.0


def test_all_problems_of_an_edit_are_given_by_key(session):
    with pytest.raises(Refusal) as refused:
        session.edited({"needle.youngs_modulus_gpa": -1, "tissue.1.alpha": "x", "target.depth_mm": 35.0})
    assert refused.value.problems == {
        "needle.youngs_modulus_gpa": "must be above 0",
        "tissue.1.alpha": "must be a number",
    }
    assert session.scenario.target.depth_mm != 35.0


@pytest.mark.parametrize(
    "key",
    [
        "nonsense",
        "needle.nonsense",
        "tissue.9.alpha",
        "tissue.999999999999999999999.alpha",
        "name.x",
        ".",
        "a..b",
    ],
)
def test_an_unknown_key_is_refused(session, key):
    with pytest.raises(Refusal):
        session.edited({key: 1.0})


@pytest.mark.parametrize(
    "value", [float("nan"), float("inf"), 10**400, "5", [], {}, {"a": [{}]}, [[1.0]], True]
)
def test_a_value_of_another_kind_is_refused(session, value):
    with pytest.raises(Refusal) as refused:
        session.edited({"target.depth_mm": value})
    assert any(key.startswith("target") for key in refused.value.problems)


def test_rules_between_sections_have_a_key(session):
    with pytest.raises(Refusal) as refused:
        session.edited({"target.depth_mm": 1000.0})
    assert "target.depth_mm" in refused.value.problems


def test_implausible_values_are_doubts(session):
    assert any(
        "youngs_modulus" in line
        for line in session.edited({"needle.youngs_modulus_gpa": 20_000}).describe().doubts
    )


def test_a_preset_begins_anew(session):
    begun = session.edited({"target.depth_mm": 35.0}).with_preset("phantom3d")
    assert begun.describe().changed == []
    assert begun.name == "phantom3d"
    assert begun.revision == session.revision + 2


def test_a_world_is_a_preset(session):
    assert session.with_preset("world:7").scenario == load_scenario("world:7")


@pytest.mark.parametrize("name", ["case", "case.toml", "../case.toml", "world:x", "world:7:nonsense"])
def test_no_other_name_is_a_preset(session, name, tmp_path, monkeypatch):
    for file in ("case", "case.toml"):
        (tmp_path / file).write_text(dump_scenario(session.scenario))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Refusal):
        session.with_preset(name)


def test_a_file_is_loaded_with_its_warnings(session, minimal_text):
    loaded = session.with_file("mine", minimal_text)
    assert (loaded.name, loaded.scenario.name, loaded.describe().changed) == ("mine", "Minimal", [])


def test_a_file_that_was_written_is_the_same_scenario(session):
    assert session.with_file("mine", dump_scenario(session.scenario)).scenario == session.scenario


@pytest.mark.parametrize("text", ["[", "\x00", 'name = "x"', "a = " + "[" * 50_000, "needle = 1"])
def test_a_file_that_is_no_scenario_is_refused(session, text):
    with pytest.raises(Refusal):
        session.with_file("mine", text)


def test_a_file_of_another_program_is_refused_in_a_few_words(session):
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
def test_a_file_that_would_take_long_to_read_is_refused_before(session, monkeypatch, text, reason):
    monkeypatch.delattr(tomllib, "loads")  # read, they take minutes and much memory
    with pytest.raises(Refusal, match=f"^mine: {reason}: no scenario has more than "):
        session.with_file("mine", text)


def test_options_that_are_not_set_stay(session):
    changed = session.with_options(OptionsRequest(type="options", seed=7))
    assert (changed.seed, changed.strategy, changed.controller) == (7, "manipulation", "")
    assert changed.revision == session.revision + 1
