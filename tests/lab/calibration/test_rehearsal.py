"""Rehearsals: what a schedule commands, and that recordings have the conventions of imported ones."""

from types import SimpleNamespace

import numpy as np
import pytest

from flexneedle import load_scenario
from flexneedle.lab.calibration.parameters import make_needle, parameters_of, trial_of
from flexneedle.lab.calibration.prediction import Replay, fitting_scenario
from flexneedle.lab.calibration.rehearsal import Rehearsal, Schedule, SensorErrors, carry_out
from flexneedle.phantom.draw import Truth
from flexneedle.phantom.plants import ExactPlant, ModelPlant
from flexneedle.types import DB_X, DG_Y, DG_Z

EXACT = SensorErrors(0.0, 0.0)
GEL = load_scenario("gel")
SPACE = GEL.with_values({"setup.axes": 2})


def schedule(axes, steps=12, travel=3.0, depth=60.0, moves=4):
    return Schedule.draw(np.random.default_rng(3), depth, steps, axes, travel=travel, moves=moves)


def rehearse(scenario, *schedules, errors=EXACT, plant=ModelPlant, **truth):
    made = Rehearsal(Truth(scenario, **truth), np.random.default_rng(5), errors, plant)
    return made.record(schedules or [schedule(scenario.setup.axes)])


class Recorder:
    """A plant that only counts: the tip is where the base and the guide are."""

    def __init__(self):
        self.rows = []

    def step(self, row):
        self.rows.append(row)

    @property
    def tip(self):
        x, y, z = np.sum(self.rows, axis=0)[[DB_X, DG_Y, DG_Z]]
        return np.array([x, y, z, 0.0, 0.0])


def test_the_guide_moves_before_the_advance_to_a_step_in_small_parts():
    plant = Recorder()
    plan = Schedule(np.array([0.0, 2.5]), np.array([[0.0, 0.0], [1.2, -0.6]]))
    tips = carry_out(plant, plan, start=-1.5)
    rows = np.array(plant.rows)
    np.testing.assert_allclose(tips[:, :3] + [-1.5, 0.0, 0.0], [[0.0, 0.0, 0.0], [2.5, 1.2, -0.6]])
    np.testing.assert_allclose(rows[:, DB_X], [0.75, 0.75, 0.0, 0.0, 0.0, *[2.5 / 3] * 3])
    np.testing.assert_allclose(rows[:, DG_Y], [0.0, 0.0, 0.4, 0.4, 0.4, 0.0, 0.0, 0.0])
    assert np.delete(rows, [DB_X, DG_Y, DG_Z], axis=1).any() == np.False_


@pytest.mark.parametrize("axes", [1, 2])
def test_a_drawn_schedule_moves_the_guide_within_its_travel_in_the_upper_two_thirds(axes):
    drawn = schedule(axes, steps=20, travel=2.0, moves=5)
    moved = np.flatnonzero(np.abs(np.diff(drawn.guide, axis=0)).max(axis=1))
    np.testing.assert_allclose(np.diff(drawn.depths), 3.0)
    assert (drawn.depths[0], drawn.guide.shape) == (0.0, (21, axes))
    np.testing.assert_array_equal(moved, [2, 4, 7, 10, 13])  # from a tenth to two thirds of 20 steps
    assert not drawn.guide[0].any()
    assert 0.5 < np.abs(drawn.guide).max() <= 2.0


@pytest.mark.parametrize("scenario", [GEL, SPACE], ids=["plane", "space"])
def test_the_model_predicts_the_recording_of_its_own_plant(scenario):
    """Depths, directions and times of guide moves are as in imported sessions."""
    session = rehearse(scenario)
    prepared = fitting_scenario(scenario, session)
    needle = make_needle(prepared, trial_of(prepared, parameters_of(prepared, (), 0.0), np.zeros(0)))
    replay = Replay.of(session)
    tips = replay.corrected(replay.predict([needle])[0][0]).predict([needle])[0][0, 0]
    (one,) = session.recordings
    axes = scenario.setup.axes
    assert np.ptp(one.position, axis=0).min() > 0.4
    np.testing.assert_allclose(tips[:, 0], one.depth, atol=0.01)
    np.testing.assert_allclose(tips[:, 1 : 1 + axes], one.position, atol=0.02)
    np.testing.assert_allclose(tips[:, 3 : 3 + axes], one.slope, atol=1e-3)


def test_readings_have_the_errors_of_the_sensor():
    plan = Schedule(np.linspace(0.0, 50.0, 400), np.zeros((400, 2)))
    errors = SensorErrors(0.2, 3e-3, axis=(0.03, -0.01))
    (true,), (read,) = (rehearse(SPACE, plan, errors=each).recordings for each in (EXACT, errors))
    assert np.std(read.depth - true.depth) == pytest.approx(0.2, rel=0.1)
    np.testing.assert_allclose(np.std(read.position - true.position, axis=0), 0.2, rtol=0.1)
    np.testing.assert_allclose(np.std(read.slope - true.slope, axis=0), 3e-3, rtol=0.1)
    np.testing.assert_allclose(np.mean(read.slope - true.slope, axis=0), [0.03, -0.01], atol=5e-4)
    assert not read.position[0].any()


def test_a_slope_is_the_tangent_of_the_angle_of_the_tip():
    plan = Schedule(np.zeros(1), np.zeros((1, 1)))
    tilted = SimpleNamespace(step=lambda _: None, tip=np.array([0.0, 0.0, 0.0, 0.4, 0.0]))
    (one,) = rehearse(GEL, plan, plant=lambda *_: tilted).recordings
    assert one.slope[0, 0] == pytest.approx(np.tan(0.4))


def test_insertions_start_from_the_phantoms_pose_and_positions_from_the_first_reading():
    plan = Schedule(np.array([0.0, 30.0]), np.array([[1.0], [3.0]]))
    (one,) = rehearse(GEL.with_values({"needle.bevel.offset_mm": 0.0}), plan, base_y=0.5).recordings
    np.testing.assert_allclose(one.guide[:, 0], [0.0, 2.0])
    assert one.position[0, 0] == 0.0
    assert one.position[1, 0] != 0.0


def test_a_session_has_its_insertions_in_order_and_repeats_with_its_seed():
    plans = [schedule(1), schedule(1, steps=8)]
    first, again = (rehearse(GEL, *plans, errors=SensorErrors()) for _ in range(2))
    assert [(one.session, one.name, len(one.depth)) for one in first.recordings] == [
        ("rehearsal", "00", 13),
        ("rehearsal", "01", 9),
    ]
    assert first.guide_order == "before"
    np.testing.assert_array_equal(first.recordings[1].slope, again.recordings[1].slope)


def test_the_exact_plant_carries_out_a_schedule_to_its_depth():
    (one,) = rehearse(GEL, plant=ExactPlant).recordings
    assert one.depth[-1] == pytest.approx(60.0, abs=0.5)
