"""Studies of worlds: an axis of numbers, each with its own scenario, target, phantom and reach."""

import pyarrow.parquet as pq
import pytest

from flexneedle.control.controllers import check_tables
from flexneedle.errors import InputError
from flexneedle.lab.study import jobs
from flexneedle.lab.study.findings.worlds import is_failure
from flexneedle.lab.study.grid import load_study
from flexneedle.lab.study.jobs import InsertionJob, run_job
from flexneedle.lab.study.plans import StudyPlans, digest_plan_inputs, digest_reach_inputs
from flexneedle.lab.study.runner import _find_reach_points
from flexneedle.lab.study.tables import write_tables
from flexneedle.record.results import RESULT_COLUMNS
from flexneedle.scenario.worlds import CASES, world
from synthetic import make_insertion

FREE, GUIDED = 15, 3  # worlds without and with a guide
STUDY = f"""
name = "few"
[[cases]]
name = "perfect"
values = {{ world_case = "perfect", plant = "model" }}
[[cases]]
name = "real"
values = {{ world_case = "real" }}
[[cases]]
name = "structure"
values = {{ world_case = "structure" }}
[[axes]]
key = "world"
values = [{FREE}, {GUIDED}]
[[axes]]
key = "controller"
values = ["open-loop", "resolved-rate"]
"""


@pytest.fixture
def load(tmp_path):
    """Return a function that loads a study from a text."""

    def study(text=STUDY, worlds=None):
        path = tmp_path / "few.toml"
        path.write_text(text)
        return load_study(path, worlds)

    return study


def test_points_have_their_world_and_case_and_none_needs_a_guide_that_is_not_there(load):
    """Omitted points are not insertions, and therefore not failures."""
    found = {(point.case, point.world, point.controller) for point in load().points}
    assert found == {
        *((case, GUIDED, name) for case in CASES for name in ("open-loop", "resolved-rate")),
        *((case, FREE, "open-loop") for case in CASES[:2]),
    }
    study = load()
    assert study.definition["insertions"] == len(study) == len(found)
    for index in range(len(study)):
        point = study.insertion(index).point
        assert point.scenario == check_tables(world(point.world, point.case))
        assert (point.world_case, study.insertion(index).seed) == (point.case, point.world)
        assert "world" not in point.varied


def test_a_study_may_have_worlds_of_the_wide_kind(load):
    study = load(
        STUDY.replace('name = "few"', 'name = "few"\n[values]\nworld_kind = "wide"').replace(
            "[15, 3]", "[2, 3]"
        )
    )
    for point in study.points:
        assert point.world_kind == "wide"
        assert point.scenario == check_tables(world(point.world, point.case, kind="wide"))
    assert load().points[0].world_kind == "world"


def test_other_worlds_can_be_requested(load):
    chosen = load(worlds=(100, 4))
    assert {point.world for point in chosen.points} == {100, 101, 102, 103}
    assert chosen.definition["axes"]["world"] == [100, 101, 102, 103]


IN_SPACE = f"""
name = "few"
[[axes]]
key = "world"
values = [{FREE}, {GUIDED}]
[[axes]]
key = "world_rig"
values = "all"
[[axes]]
key = "controller"
values = ["open-loop", "resolved-rate"]
"""
NAMED = 'name = "a"\n'
ODD = STUDY.replace('"structure" }', '"odd" }')
FRACTION = STUDY.replace(f"[{FREE}, {GUIDED}]", "[1.5]")
FAR = '[[axes]]\nkey = "target"\nvalues = [[10, 50]]'


@pytest.mark.parametrize(
    ("text", "worlds", "message"),
    [
        (
            STUDY,
            (-1, 4),
            "worlds = -1, 4: must be the first number, 0 to 1000000000, and a count, 1 to 100000",
        ),
        (STUDY, (0, 0), "worlds = 0, 0: must be the first number"),
        (STUDY, (10**9, 2), "world = 1000000001: must be a whole number from 0 to 1000000000"),
        (NAMED, (0, 2), "no axis of worlds: --worlds needs one"),
        (FRACTION, None, "values = [1.5]: must be whole numbers from 0 to 1000000000"),
        (
            'scenario = "phantom"' + STUDY,
            None,
            'scenario = "phantom": remove it: an axis sets the worlds',
        ),
        (STUDY + FAR, None, "target.lateral_mm"),
        (
            NAMED + "values = { world = 3 }",
            None,
            "values.world = 3: not allowed here: set worlds with an axis",
        ),
        (NAMED + 'values = { world_case = "real" }', None, "world_case: needs an axis of worlds"),
        (NAMED + 'values = { world_rig = "two-axes" }', None, "world_rig: needs an axis of worlds"),
        (NAMED + 'values = { world_kind = "wide" }', None, "world_kind: needs an axis of worlds"),
        (ODD, None, 'world_case = "odd": must be one of perfect, real, structure'),
        (IN_SPACE.replace('"all"', '["three"]'), None, 'world_rig = "three": must be one of plane, two-axes'),
    ],
)
def test_a_study_of_worlds_that_cannot_be_is_refused(load, text, worlds, message):
    with pytest.raises(InputError) as caught:
        load(text, worlds)
    assert message in str(caught.value)


@pytest.mark.slow
def test_the_shipped_studies_have_two_hundred_worlds_not_used_for_tuning():
    study = load_study("worlds")
    numbers = {point.world for point in study.points}
    assert numbers == set(range(100_000, 100_200))
    guided = {number for number in numbers if world(number).setup.has_guide}
    for case, plant in (("perfect", "model"), ("real", "exact"), ("structure", "exact")):
        points = [point for point in study.points if point.case == case]
        assert {point.plant for point in points} == {plant}
        worlds = numbers if case != "structure" else guided
        assert {point.world for point in points if point.controller == "open-loop"} == worlds
    study = load_study("wide")
    assert {(point.world, point.world_kind) for point in study.points} == {
        (n, "wide") for n in sorted(numbers)
    }
    assert {point.case for point in study.points} == {"real", "structure"}
    study = load_study("worlds-space")
    with_guide, without = 4 * 4, 2 * 3  # drivers by controllers; resolved-rate needs a guide
    assert len(study) == 2 * (with_guide * len(guided) + without * (200 - len(guided)))
    assert {point.scenario.setup.axes for point in study.points} == {2}
    assert all(study.insertion(k).seed == study.insertion(k).point.world for k in range(0, len(study), 97))


def test_the_reach_is_computed_once_for_all_controllers_of_a_world_and_case(load):
    study = load()
    chosen = [point for point in study.points if id(point) in _find_reach_points(study)]
    assert [(point.case, point.world) for point in chosen] == [
        *(("perfect", FREE), ("perfect", GUIDED), ("real", FREE), ("real", GUIDED), ("structure", GUIDED))
    ]
    assert len({digest_reach_inputs(point) for point in study.points}) == 5
    assert len({digest_plan_inputs(point) for point in study.points}) == 2


def test_a_job_computes_the_reach_if_requested(load, monkeypatch):
    point = load().points[0]
    monkeypatch.setattr(
        jobs,
        "compute_reach",
        lambda scenario, seed, _plant, strategy: (
            (point.scenario is scenario and strategy == "manipulation") * seed * 0.1
        ),
    )
    for with_reach, expected in ((True, 0.5), (False, None)):
        (row,) = run_job(InsertionJob(point, None, "no plan", ((0, 5),), with_reach))
        assert row["reach_mm"] == expected
        assert row["outcome"] == "error"


def test_a_failed_reach_is_recorded_and_does_not_change_the_outcome(load, monkeypatch):
    done = make_insertion()

    def reach(*_args):
        raise ZeroDivisionError("nowhere")

    monkeypatch.setattr(jobs, "compute_reach", reach)
    monkeypatch.setattr(jobs, "insert_at", lambda *_args, **_options: done)
    monkeypatch.setattr(jobs, "_sum_times", lambda _insertion: {})
    (row,) = run_job(InsertionJob(load().points[0], done.plan, "", ((0, 5),), True))
    assert (row["outcome"], row["reason"]) == ("done", "no reach: ZeroDivisionError: nowhere")
    assert row["reach_mm"] is None


def test_the_table_has_the_reach_in_every_row_of_the_same_truth(load, tmp_path):
    """From whichever controller's insertion; unknown if none has computed it yet."""
    study = load()
    empty = {**dict.fromkeys(RESULT_COLUMNS), "outcome": "done", "reason": ""}
    found = {
        index: {**empty, "index": index, "reach_mm": 0.1 * index if index in _reach_rows(study) else None}
        for index in range(len(study) - 2)
    }
    write_tables(tmp_path, study, found, StudyPlans(tmp_path / "plans"))
    table = pq.read_table(tmp_path / "runs.parquet").to_pylist()
    of_truth = {
        (row["case"], row["world"]): row["reach_mm"] for row in table if row["controller"] == "open-loop"
    }
    assert all(row["reach_mm"] == of_truth[row["case"], row["world"]] is not None for row in table)
    assert {row["world_case"] for row in table} == {"perfect", "real"}


def _reach_rows(study):
    return [
        index for index in range(len(study)) if id(study.insertion(index).point) in _find_reach_points(study)
    ]


@pytest.mark.parametrize(
    ("outcome", "reach", "failure"),
    [
        *(("done", 0.0, False), ("held", 0.3, True), ("refused", 1.2, False), ("failed", None, True)),
        *(("held", 1.5, True), ("failed", 1.5, False), ("held", 2.1, False)),
    ],
)
def test_an_unfinished_insertion_is_a_failure_if_the_target_is_within_reach(outcome, reach, failure):
    """Within 1 mm; for a hold within the miss at which a controller may hold."""
    row = {"outcome": outcome, "reach_mm": reach, "control.miss_limit_mm": 2.0}
    assert is_failure(row) == failure


def test_each_world_has_the_rigs_that_it_can_have(load):
    """Of those with the guide of the world, and that in the plane."""
    study = load(IN_SPACE)
    found = {(point.world, point.world_rig, point.controller) for point in study.points}
    guided = ("plane", "two-axes", "two-axes-half-turns", "one-axis", "one-axis-half-turns")
    assert found == {
        *((GUIDED, rig, name) for rig in guided for name in ("open-loop", "resolved-rate")),
        *((FREE, rig, "open-loop") for rig in ("plane", "no-guide", "no-guide-half-turns")),
    }
    for point in study.points:
        assert point.scenario == check_tables(world(point.world, "real", point.world_rig))
        assert point.varied["world_rig"] == point.world_rig
