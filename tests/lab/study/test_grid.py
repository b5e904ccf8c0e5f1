"""Study files: the grid, its order and seeds; and one line for each violated rule."""

import importlib.util
import itertools
import tomllib
from pathlib import Path

import pyarrow as pa
import pytest

from flexneedle.control.controllers import CONTROLLERS as INCLUDED
from flexneedle.control.controllers import check_tables
from flexneedle.errors import InputError
from flexneedle.lab.study.grid import load_study
from flexneedle.lab.study.spec import LARGEST_SEED, STUDIES
from flexneedle.scenario.files import dump_scenario, load_scenario

PHANTOM = check_tables(load_scenario("phantom"))
CONTROLLERS = tuple(INCLUDED)[:2]
DEPTHS, LATERALS = (25, 30, 35, 40, 45), (-5, 0, 5)


@pytest.fixture
def study(tmp_path):
    """Return a function that loads a study from the text of its file, after a line with its name."""

    def load(text):
        path = tmp_path / "my.toml"
        path.write_text(f'name = "my"\n{text}')
        return load_study(path)

    return load


def insertions(study):
    return [study.insertion(index) for index in range(len(study))]


def refusal(study, text):
    """Return the message about a study file, without the file name."""
    with pytest.raises(InputError) as caught:
        study(text)
    lines = [line.split("my.toml: ", 1) for line in str(caught.value).splitlines()]
    assert all(len(line) == 2 for line in lines)
    return [line[1] for line in lines]


TWO_BY_TWO = """
repeats = 2
first_seed = 50
[[cases]]
name = "base"
[[cases]]
name = "rough"
values = { phantom.run_out_mm = 0.4 }
[[axes]]
key = "target"
values = [[30, 0], [40, 5]]
[[axes]]
key = "controller"
values = ["CONTROLLERS"]
""".replace("CONTROLLERS", '", "'.join(CONTROLLERS))


def test_cases_vary_slowest_then_axes_in_their_order_and_repeats_fastest(study):
    got = [
        (i.point.case, i.point.scenario.target.position, i.point.controller, i.repeat)
        for i in insertions(study(TWO_BY_TWO))
    ]
    targets, controllers = [(30.0, 0.0, 0.0), (40.0, 5.0, 0.0)], list(CONTROLLERS)
    assert got == list(itertools.product(["base", "rough"], targets, controllers, [0, 1]))


def test_a_case_sets_its_values_and_nothing_else(study):
    base, rough = (study(TWO_BY_TWO).points[k].scenario for k in (0, 4))
    assert base == PHANTOM.with_values({"target.depth_mm": 30, "target.lateral_mm": 0})
    assert rough == base.with_values({"phantom.run_out_mm": 0.4})


def test_each_target_and_repeat_has_its_own_seed_at_all_other_settings(study):
    seeds = {}
    for insertion in insertions(study(TWO_BY_TWO)):
        key = insertion.point.scenario.target.position, insertion.repeat
        seeds.setdefault(key, set()).add(insertion.seed)
    assert [min(own) for own in seeds.values()] == [50, 51, 52, 53]
    assert all(len(own) == 1 for own in seeds.values())


@pytest.mark.parametrize("values", ["[3, 5, 9]", "{ from = 3, count = 3 }"])
def test_an_axis_of_seeds_gives_all_targets_the_same_seeds(study, values):
    text = f'[[axes]]\nkey = "seed"\nvalues = {values}\n[[axes]]\nkey = "target.depth_mm"\nvalues = [30, 40]'
    expected = [3, 5, 9] if values.startswith("[") else [3, 4, 5]
    assert [(i.repeat, i.seed) for i in insertions(study(text))] == 2 * list(enumerate(expected))


def test_values_apply_to_all_points_and_axes_and_cases_override_them(study):
    text = "[values]\nplant = 'model'\nphantom.run_out_mm = 1.0\nplan_seed = 4\n" + TWO_BY_TWO.split("50")[1]
    points = study(text).points
    assert {(point.plant, point.plan_seed) for point in points} == {("model", 4)}
    assert [point.scenario.phantom.run_out_mm for point in points] == [1.0] * 4 + [0.4] * 4


OWN_TARGETS = """
repeats = 2
first_seed = 50
[values]
setup.axes = 2
[[axes]]
key = "controller"
values = ["CONTROLLERS"]
[[cases]]
name = "any"
targets = [[30, 1, 2], [40, 5]]
[[cases]]
name = "one axis"
values = { setup.guide_axes = 1 }
reach = true
targets = [[30, 1, 2], [35, 0, -1]]
[[cases]]
name = "as in the scenario"
""".replace("CONTROLLERS", '", "'.join(CONTROLLERS))


def test_a_case_may_have_its_own_targets(study):
    """They vary after the cases and before the axes. The default is the scenario's target, and z = 0."""
    points = study(OWN_TARGETS).points
    targets = [(point.case, point.scenario.target.position) for point in points[::2]]
    assert targets == [
        ("any", (30.0, 1.0, 2.0)),
        ("any", (40.0, 5.0, 0.0)),
        ("one axis", (30.0, 1.0, 2.0)),
        ("one axis", (35.0, 0.0, -1.0)),
        ("as in the scenario", PHANTOM.target.position),
    ]
    assert [point.controller for point in points] == 5 * list(CONTROLLERS)
    assert {point.scenario.setup.guide_axes for point in points if point.case == "one axis"} == {1}
    assert all(set(point.varied) == {"controller"} for point in points)
    assert [point.with_reach for point in points] == [False] * 4 + [True] * 4 + [False] * 2
    seeds = {}
    for insertion in insertions(study(OWN_TARGETS)):
        seeds.setdefault(insertion.point.scenario.target.position, set()).add(insertion.seed)
    expected = {(30.0, 1.0, 2.0): {50, 51}, (40.0, 5.0, 0.0): {52, 53}, (35.0, 0.0, -1.0): {54, 55}}
    assert seeds == expected  # equal targets share seeds; the last case has the target of the first


def test_a_target_of_two_numbers_is_in_the_plane(study):
    points = study('scenario = "phantom3d"\n[[axes]]\nkey = "target"\nvalues = [[30, 1, 2], [30, 1]]').points
    assert [point.scenario.target.position for point in points] == [(30.0, 1.0, 2.0), (30.0, 1.0, 0.0)]


def test_keys_of_the_base_can_be_removed(study):
    text = (
        'without = ["needle.outer_diameter_mm", "needle.inner_diameter_mm"]\n[values]\nneedle.gauge = "19G"'
    )
    needle = study(text).points[0].scenario.needle
    assert (needle.gauge, needle.outer_diameter_mm, needle.outer_diameter) == ("19G", None, 1.067)


def test_a_scenario_path_is_relative_to_the_study_file(study, tmp_path):
    scenario = PHANTOM.with_values({"name": "Beside", "setup.stroke_mm": 100})
    (tmp_path / "beside.toml").write_text(dump_scenario(scenario))
    assert study('scenario = "beside.toml"').points[0].scenario == scenario


def test_a_study_with_only_a_name_is_one_insertion_of_the_preset(study):
    (only,) = insertions(study(""))
    assert (only.point.scenario, only.point.case, only.seed, only.point.plan_seed) == (PHANTOM, "", 0, 0)


def test_the_largest_seeds_fit_into_a_table(study):
    longest = f"first_seed = {LARGEST_SEED}\nrepeats = 100_000\n" + axis("target.depth_mm", "[30, 40]")
    axes = axis("seed", f"{{from = {LARGEST_SEED}, count = 2}}") + axis("plan_seed", f"[0, {LARGEST_SEED}]")
    for text in (longest, axes):
        whole = study(text)
        last = whole.insertion(len(whole) - 1)
        seeds = pa.array([last.seed, last.point.plan_seed], pa.int64()).to_pylist()
        assert seeds == [last.seed, last.point.plan_seed]
        assert last.seed > LARGEST_SEED


def in_space(case):
    """A study in space with one case."""
    return f'[values]\nsetup.axes = 2\n[[cases]]\nname = "a"\n{case}\n'


def axis(key, values):
    return f"[[axes]]\nkey = '{key}'\nvalues = {values}\n"


TWO_CASES = "[[cases]]\nname = 'a'\n"
BAD = [  # text and key named
    ("repeat = 3", "repeat = 3: unknown key; did you mean repeats?"),
    ("repeats = 0", "repeats = 0"),
    (f"first_seed = {LARGEST_SEED + 1}", f"first_seed = {LARGEST_SEED + 1}"),
    ("first_seed = true", "first_seed = true"),
    ("scenario = 'no.toml'", "/no.toml: no such file"),
    ("x = ", "not TOML: "),
    ("without = ['needle.gauge']", 'without = "needle.gauge"'),
    ("[values]\ncontroller = 'pid'", f'controller = "pid": must be one of {", ".join(INCLUDED)}'),
    ("[values]\nplant = 'real'", 'plant = "real": must be one of exact, model'),
    ("[values]\nstrategy = 'x'", 'strategy = "x": must be one of manipulation, steering'),
    ("[values]\nplan_seed = 1.5", "plan_seed = 1.5"),
    (axis("plan_seed", f"[1, {2**63}]"), f"plan_seed = {2**63}"),
    ("[values]\nseed = 3", "values.seed = 3"),
    ("[values]\ntarget = 3", "values.target = 3"),
    ("[values]\ncontrol.ce_mcp.horizon = 3", "control.ce_mcp: unknown table; did you mean ce_mpc?"),
    (axis("plan.sample", "[16]"), "plan.sample = 16: unknown key; did you mean samples?"),
    (axis("controler", '["ce-mpc"]'), "as an axis also seed, world"),
    (axis("plan.samples", "[]"), "axes[0].values = []"),
    (
        axis("tissue.0.youngs_modulus_kpa", "[6]")
        + TWO_CASES
        + "values = {'tissue[0].shear_modulus_kpa' = 8}",
        'cases[0].values = "tissue.0.shear_modulus_kpa": also set by an axis',
    ),
    (axis("plan.samples", "'all'"), 'axes[0].values = "all"'),
    (axis("setup.stroke_mm", "[100, 100.0]"), "contains 100 twice"),
    (axis("target", "[[30, 0], [30.0, -0.0]]"), "contains [30, 0] twice"),
    (axis("controller", f"['{CONTROLLERS[0]}', 'x']"), 'controller = "x"'),
    (axis("controller", '"al"'), 'axes[0].values = "al": must be a list of at least one value, or "all"'),
    (axis("target", "[[30, 0], 40]"), "axes[0].values = 40"),
    (in_space("targets = 3"), "cases[0].targets = 3"),
    (in_space("targets = [[30]]"), "cases[0].targets = [30]"),
    (in_space("targets = [[30, 1]]\nvalues = { target.depth_mm = 30 }"), "cases[0].values.target.depth_mm"),
    (in_space("targets = [[30, 1]]") + axis("world", "[3]"), "cases[0].targets: also set"),
    (in_space("targets = [[30, 1, 99]]"), "target.lateral_z_mm = 99.0"),
    (axis("target", "[[30, 0, 1]]"), "target.lateral_z_mm = 1.0"),
    (axis("seed", "[1, -2]"), "axes[0].values = [1, -2]"),
    (axis("seed", f"{{from = {2**62 + 1}, count = 2}}"), "axes[0].values = {…}"),
    (axis("seed", "{from = 1}"), "axes[0].values = {…}: must be a list, or {from, count}"),
    ("repeats = 2\n" + axis("seed", "[1]"), "repeats = 2: remove it"),
    (axis("target", "[[30, 0]]") + axis("target.depth_mm", "[30]"), 'axes = "target.depth_mm"'),
    (
        axis("plan.samples", "[16]") + TWO_CASES + "values = {plan.samples = 8}",
        'cases[0].values = "plan.samples"',
    ),
    (2 * TWO_CASES, 'cases = "a": names must be unique'),
    ("[[axes]]\nvalues = [1]", "axes[0].key: missing"),
    ("repeats = 100_000\n" + axis("plan.samples", str(list(range(16, 28)))), "insertions = 1200000"),
]


@pytest.mark.parametrize(("text", "line"), BAD)
def test_a_bad_study_file_is_rejected_in_one_line_with_the_problem(study, text, line):
    (message,) = refusal(study, text)
    assert line in message


def test_an_invalid_setting_is_reported_with_its_grid_point_and_an_unknown_study_with_the_valid_names(study):
    with pytest.raises(InputError, match=r"^nope: no such file, and no such study \(choices: controllers, "):
        load_study("nope")
    (message,) = refusal(study, axis("plan.samples", "[16, 32]") + axis("setup.stroke_mm", "[100, 140]"))
    assert message.endswith("(at plan.samples = 16, setup.stroke_mm = 140)")


@pytest.mark.slow
def test_the_shipped_studies_load():
    """Loading checks every scenario of the grid against all rules, including targets within the stroke."""
    sizes = {name: len(load_study(name)) for name in STUDIES.names()}
    assert sizes == {
        "phantom": 150,
        "phantom-published": 150,
        "odd-targets": 150,
        "controllers": 150 * len(INCLUDED),
        "mismatch": 5 * 150,
        "mismatch-doubled": 1500,
        "imperfections": 18 * 150,
        "guide-distance": 7 * 150,
        "gauges": 8 * 150,
        "tracker": 5 * 150,
        "sensors": 11 * 30,
        "wide": 1425,
        "worlds": 2202,
        "space": 3 * 4 * 150,
        "worlds-space": 5740,
    }


def test_shipped_studies_share_the_papers_targets_and_their_phantoms_on_purpose():
    """As their headers state; the long study has other seeds."""
    of_phantom = insertions(load_study("phantom"))
    targets = [insertion.point.scenario.target.position[:2] for insertion in of_phantom]
    assert targets == [target for target in itertools.product(DEPTHS, LATERALS) for _ in range(10)]
    seeds = {}
    for insertion in insertions(load_study("controllers")):
        seeds.setdefault(insertion.point.controller, []).append(insertion.seed)
    assert list(seeds) == list(INCLUDED)
    paper = [insertion.seed for insertion in of_phantom]
    assert all(own == paper == list(range(100000, 100150)) for own in seeds.values())
    study = load_study("mismatch-doubled")
    (phantom,) = {point.scenario.phantom for point in study.points}
    published = {"start_axial_sd_mm": 0.0, "youngs_modulus_variation": 0.0}
    assert phantom == settings(load_study("mismatch"), "s = 2").phantom.model_copy(update=published)
    assert sorted(i.seed for i in insertions(study)) == list(range(200_000, 200_000 + len(study)))
    setups = [point.scenario.setup for point in load_study("guide-distance").points]
    assert {setup.guide_to_skin_mm - setup.tip_to_skin_mm for setup in setups} == {12.5}


def test_the_targets_of_space_are_the_drawn_ones(capsys):
    """`studies/space_targets.py` prints them."""
    path = Path(__file__).parents[3] / "studies" / "space_targets.py"
    spec = importlib.util.spec_from_file_location("space_targets", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.main([])
    lists = capsys.readouterr().out.split("targets = ")[1:]
    drawn = [tomllib.loads(f"targets = {text}")["targets"] for text in lists]
    assert drawn == list(load_study("space").definition["targets"].values())


def settings(study, case):
    return next(point.scenario for point in study.points if point.case == case)


def test_mismatch_grows_from_none_through_the_preset_to_the_doubled():
    study = load_study("mismatch")
    at = {float(case[4:]): settings(study, case).phantom for case in study.definition["cases"]}
    assert list(at) == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert at[1.0] == PHANTOM.phantom
    assert (at[0.0].shear_modulus_factor, at[0.0].bevel_factor) == ((1.0, 1.0), (1.0, 1.0))
    assert (at[2.0].shear_modulus_factor, at[2.0].bevel_factor) == ((0.3, 2.5), (0.0, 2.0))
    for s, low, high in ((0.5, 0.0, 1.0), (1.5, 1.0, 2.0)):
        ends = zip(at[low].shear_modulus_factor, at[high].shear_modulus_factor, strict=True)
        assert at[s].shear_modulus_factor == pytest.approx([(a * b) ** 0.5 for a, b in ends], rel=1e-3)
    for s, phantom in at.items():
        assert phantom.bevel_factor == (1 - s / 2, 1 + s / 2)
        assert (phantom.start_offset_sd_mm, phantom.start_angle_sd_mrad) == (0.5 * s, 3 * s)


def test_each_imperfection_is_changed_alone():
    study = load_study("imperfections")
    base = settings(study, "base").flat()
    changed = {}
    for case in list(study.definition["cases"])[1:]:
        values = settings(study, case).flat()
        ((key, value),) = [(key, value) for key, value in values.items() if base[key] != value]
        changed[key] = (base[key], value)
    own = {f"phantom.{name}" for name in type(PHANTOM.phantom).model_fields}
    sizes = {f"phantom.{name}_mm" for name in ("contact_spacing", "element", "step")}
    out_of_plane = (
        "start_offset_z_sd_mm",
        "start_angle_z_sd_mrad",
        "direction_spread_deg",
        "rotation_friction_mn",
    )
    none_in_the_plane = {f"phantom.{name}" for name in out_of_plane}
    faults = {f"phantom.tracker_{name}_mm" for name in ("drift", "lost")}
    assert own - set(changed) == {*sizes, *none_in_the_plane, *faults, "phantom.structure"}
    assert changed.pop("phantom.tracker_bias_mm") == (0.0, 0.3)
    assert changed.pop("phantom.shear_modulus_factor") == ([0.6, 1.6], [0.3, 2.5])
    assert changed.pop("phantom.bevel_factor") == ([0.5, 1.5], [0.0, 2.0])
    assert all(after == 2 * before for before, after in changed.values())
