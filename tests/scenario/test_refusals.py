"""Every rule of a scenario file has one line: file, key, value, rule."""

import tomllib
from importlib.resources import files

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from flexneedle.control.controllers import check_tables
from flexneedle.errors import ScenarioError
from flexneedle.scenario.files import load_scenario
from flexneedle.scenario.model import Scenario
from scenario_rules import ABOVE_ZERO, COUNTS, NOT_NEGATIVE, POSITIVE, RULES

PHANTOM = check_tables(load_scenario("phantom"))
MECHANICS = ("shear_modulus_kpa", "alpha", "compression_length_mm", "engaged_width_mm")


def problems(values, source="case.toml"):
    with pytest.raises(ScenarioError) as caught:
        check_tables(Scenario.from_values(values, source), source=source)
    lines = caught.value.problems
    assert all(line.startswith(f"{source}: ") and line.isprintable() for line in lines)
    return [line.removeprefix(f"{source}: ") for line in lines]


def changed(key, value):
    """Return the phantom's values with one value set, by the path that messages use; None takes it out."""
    values = PHANTOM.values()
    *way, last = [
        int(part) if part.isdigit() else part for part in key.replace("[", ".").replace("]", "").split(".")
    ]
    table = values
    for part in way:
        table = table[part]
    table[last] = value
    if value is None:
        del table[last]
    return values


def test_a_target_out_of_reach_from_the_entry_is_refused():
    """The message has the range around the needle's axis at this depth, including the free part."""
    entry = {"lateral_mm": 20.0, "slope_mrad": 25.0, "free_radius_mm": 0.5}
    (line,) = problems({**PHANTOM.values(), "entry": entry})
    assert line == "target.lateral_mm = 5.0: must be from 5.5 to 36.5, in reach of the guide from the entry"


def test_zones_differ_in_name_and_a_common_margin_is_refused_once():
    ball = {"name": "a", "shape": "sphere", "center_mm": [20.0, 5.0, 0.0], "radius_mm": 1.0}
    values = {**PHANTOM.values(), "zone": [ball, {**ball, "name": "b"}]}
    assert problems({**values, "zones": {"margin_mm": 0.1}}) == [
        "zones.margin_mm = 0.1: must be at least guard.zone_buffer_mm (0.5)"
    ]
    assert problems({**values, "zone": [ball, ball]}) == [
        'zone[1].name = "a": must differ from the name of zone[0]'
    ]


@pytest.mark.parametrize(("key", "value", "rule"), RULES, ids=lambda part: str(part)[:30])
def test_a_broken_rule_is_one_line(key, value, rule):
    (line,) = problems(changed(key, value))
    named, message = line.split(": ", maxsplit=1)
    assert named.split(" = ")[0] == key
    assert message.startswith(rule)


@pytest.mark.parametrize("key", POSITIVE)
@pytest.mark.parametrize("value", [0, -1.0])
def test_zero_and_less_is_refused(key, value):
    no_guide = value == 0 and key in ("setup.max_guide_step_mm", "setup.max_guide_travel_mm")
    remedy = "; to go without a guide leave out setup.guide_to_skin_mm" if no_guide else ""
    assert problems(changed(key, value)) == [f"{key} = {value}: {ABOVE_ZERO}{remedy}"]


@pytest.mark.parametrize("key", NOT_NEGATIVE)
def test_less_than_zero_is_refused(key):
    assert problems(changed(key, -0.5)) == [f"{key} = -0.5: must be at least 0"]


@pytest.mark.parametrize(("key", "bounds"), COUNTS.items())
def test_counts_have_bounds(key, bounds):
    least, most = bounds
    assert problems(changed(key, least - 1)) == [f"{key} = {least - 1}: must be at least {least}"]
    assert problems(changed(key, most + 1)) == [f"{key} = {most + 1}: must be at most {most:g}"]


def test_every_number_of_the_schema_is_covered_by_a_test_of_its_bounds():
    tested = {key for key, _, _ in RULES} | set(POSITIVE) | set(NOT_NEGATIVE) | set(COUNTS)
    names = {key.replace("[0]", "").replace("[1]", "") for key in tested}
    numbers = {
        key.replace(".0", "").replace(".1", "") for key, value in PHANTOM.flat().items() if value is not True
    }
    assert numbers - names == {"tissue.name", "tissue.law"}


def test_a_window_without_two_frames_would_never_know_the_field():
    """A window that the monitor does not use may be of any length."""
    short = {"tracker.environment": "ideal", "monitor.indicator_window_s": 0.04}
    with pytest.raises(ScenarioError) as caught:
        PHANTOM.with_values(short)
    (line,) = caught.value.problems
    assert line.endswith(
        "monitor.indicator_window_s = 0.04: must be at least 0.05, 2 frames at tracker.rate_hz (40)"
    )
    PHANTOM.with_values(short | {"monitor.indicator_window_s": 0.05})
    for unjudged in (
        {"tracker.environment": "none"},
        {"monitor.references": 0},
        {"monitor.enabled": False},
    ):
        PHANTOM.with_values(short | unjudged)


@pytest.mark.parametrize(
    ("key", "rule"),
    [
        *((key, "missing") for key in ("name", "needle", "setup", "tissue", "setup.stroke_mm")),
        *((f"tissue[{n}].{key}", "missing") for n in (0, 1) for key in MECHANICS),
        ("tissue[0].thickness_mm", "missing: every layer but the last needs a thickness"),
        ("needle.outer_diameter_mm", "missing: give it, or a gauge such as 21G"),
    ],
)
def test_a_required_key_is_missed(key, rule):
    assert problems(changed(key, None)) == [f"{key}: {rule}"]


def test_a_gauge_replaces_the_diameters():
    assert [line.split(": ")[0] for line in problems(changed("needle.gauge", "21G"))] == [
        "needle.outer_diameter_mm = 0.819",
        "needle.inner_diameter_mm = 0.0",
    ]
    (line,) = problems(changed("needle.gauge", "16G"))
    assert line.startswith('needle.gauge = "16G": must be one of 17G, 18G, 19G')


def test_all_problems_are_reported_together():
    values = changed("tissue[0].alpha", 0)
    values["needle"]["nodes"] = 1
    values["plan"]["sample"] = 5
    assert [line.split(" = ")[0] for line in problems(values)] == [
        "needle.nodes",
        "tissue[0].alpha",
        "plan.sample",
    ]


def test_a_long_or_odd_value_stays_one_short_line():
    (line,) = problems(changed("needle.length_mm", "a\nb" * 1000))
    assert len(line) < 120
    (line,) = problems({**PHANTOM.values(), "odd\nkey": {"x": 1}})
    assert line.startswith('"odd\\nkey" = {…}: unknown key')


json_like = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@given(key=st.sampled_from(sorted(PHANTOM.flat())), value=json_like)
def test_any_value_gives_a_scenario_or_one_line_each(key, value):
    try:
        check_tables(PHANTOM.with_values({key: value}))
        message = ["fine"]
    except ScenarioError as error:
        message = list(error.problems)
    assert message
    assert all(line.isprintable() for line in message)


# files


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'name = "\xff"', "not UTF-8 (at line 1)"),
        ('name = "a"\n'.encode("utf-16"), "not UTF-8 (at line 1)"),
        (b'name = "a"\nneedle = [\n', "not TOML: Invalid value (at end of document)"),
        (b'name = "a"\nlength = 1 mm\n', "not TOML: "),
        (b"a = " + b"[" * 100_000, "not TOML: nested too deeply"),
        (b"a = " + b"1" * 10_000, "not TOML: "),
        (b"#" * 1_000_001, "larger than 1000000 bytes, not a scenario file"),
        (b"", "name: missing"),
    ],
    ids=["latin", "utf-16", "end", "syntax", "deep", "digits", "large", "empty"],
)
def test_a_file_that_is_no_scenario_is_refused(content, message, scenario_file):
    path = scenario_file(content)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    assert caught.value.problems[0].startswith(f"{path}: {message}")


def test_a_syntax_error_names_its_line(scenario_file):
    with pytest.raises(ScenarioError, match=r"not TOML: .*\(at line 2, column 12\)"):
        load_scenario(scenario_file('name = "a"\nlength = 1 mm\n'))


@pytest.mark.parametrize(
    ("line", "number"),
    [("a = 60,0  # note", "60,0"), ("a = {b = -1,5e1}", "-1,5e1"), ("a=1.000,5", "1.000,5")],
)
def test_a_decimal_comma_is_named_with_its_line(scenario_file, line, number):
    rule = rf"\(at line 2, column \d+\): {number}: write a decimal point, not a comma$"
    with pytest.raises(ScenarioError, match=rule):
        load_scenario(scenario_file(f'name = "a"\n{line}\n'))
    with pytest.raises(ScenarioError, match="not TOML") as caught:
        load_scenario(scenario_file("a = 'x', 'y'\nb = 1.5"))
    assert "write a decimal point" not in str(caught.value)


def test_a_wrong_value_in_a_file_names_the_file(scenario_file):
    text = (files("flexneedle.scenario") / "presets" / "phantom.toml").read_text(encoding="utf-8")
    path = scenario_file(text.replace("offset_mm = 4.0", "offset_mm = inf"))
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    assert str(caught.value) == f"{path}: needle.bevel.offset_mm = inf: must be a finite number"


def test_a_byte_order_mark_and_windows_line_ends_are_accepted(minimal_text, scenario_file):
    content = b"\xef\xbb\xbf" + minimal_text.replace("\n", "\r\n").encode()
    assert load_scenario(scenario_file(content)).name == "Minimal"


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("phantm", "phantm: no such file, and no such preset (choices: gel, phantom, phantom3d)"),
        ("", '"": is a directory'),
        ("/", "/: is a directory, not a scenario file"),
        ("a\0b", "a\\x00b: cannot be read"),
        ("a\nb", "a\\nb: no such file"),
        ("a/" * 5000, "a/a/"),
        ("/dev/zero", "/dev/zero: larger than 1000000 bytes"),
        (None, "scenario = None: must be a preset name, a path or a Scenario"),
    ],
)
def test_a_source_that_cannot_be_read_is_refused(source, message):
    with pytest.raises(ScenarioError) as caught:
        load_scenario(source)
    (line,) = caught.value.problems
    assert line.startswith(message)
    assert line.isprintable()


def test_the_written_file_loads_by_path_and_by_name(scenario_file):
    path = scenario_file(tomli_w.dumps(PHANTOM.values()))
    assert load_scenario(path) == load_scenario(str(path)) == PHANTOM
    assert Scenario.from_values(tomllib.loads(path.read_text())) == PHANTOM
