"""Records of versions without a second axis: a run that one of them wrote is read, and each value is where it belongs.

`planar` is that run: the bevel at first on the side −1, two flips, motion of base and guide, lost readings.
"""

import gzip
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import flexneedle
from flexneedle.record.columns import COLUMNS, from_row, to_row
from flexneedle.record.plain import plan_from_values, plan_values
from flexneedle.record.planar import plan_in_space, row_in_space
from flexneedle.record.reader import read_trace
from flexneedle.record.writer import TraceWriter
from flexneedle.types import Action, Outcome, Pose

STORED = Path(__file__).parent / "planar"
MOVED = {  # columns with other names or values
    "tip_load_n": "tip_load_y_n",
    "miss_mm": "miss_y_mm",
}
REPLACED = {"bevel", "command_flip", "applied_flip"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("planar")
    shutil.copy(STORED / "run.json", folder)
    (folder / "trace.mcap").write_bytes(gzip.decompress((STORED / "trace.mcap.gz").read_bytes()))
    return folder


@pytest.fixture(scope="module")
def loaded(folder):
    return flexneedle.load(folder)


@pytest.fixture(scope="module")
def plan_then():
    """The plan as it was written."""
    (plan,) = json.loads((STORED / "run.json").read_text())["plans"].values()
    return plan


@pytest.fixture(scope="module")
def rows_then(folder):
    """The rows of the periods as they were written."""
    return [
        {pair.key: pair.value for pair in message.status[0].values}
        for message in messages(folder, "/control/status")
    ]


def messages(folder, topic):
    with AnyReader([folder / "trace.mcap"], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        found = [one for one in reader.connections if one.topic == topic]
        return [reader.deserialize(raw, one.msgtype) for one, _, raw in reader.messages(connections=found)]


def planar(rows, *columns):
    """These columns of rows, every other of which is 0."""
    rows = np.asarray(rows)
    assert (np.delete(rows, columns, axis=-1) == 0.0).all()
    return rows[..., list(columns)]


# ---- the run


def test_a_planar_run_is_loaded(loaded):
    assert (loaded.outcome, loaded.reason) == (Outcome.DONE, "missed the target by 1.57 mm")
    assert (loaded.controller, loaded.phantom, loaded.seed) == ("open-loop", "exact", 3)
    assert (loaded.flips, loaded.plan.flips, len(loaded.periods)) == (2, 2, 8)
    assert loaded.scenario.name == "Planar record"
    assert loaded.scenario.setup.axes == 1
    assert loaded.target == (12.0, -1.0, 0.0)


def test_results_are_those_of_then(loaded):
    then = json.loads((STORED / "run.json").read_text())["result"]
    assert loaded.true_error_mm == pytest.approx(then["true_error_mm"], rel=1e-12)
    assert loaded.residual_mm == pytest.approx(then["residual_mm"], rel=1e-12)
    assert loaded.plan.error_mm == pytest.approx(then["planned_error_mm"], rel=1e-12)
    assert loaded.held_s == pytest.approx(then["held_s"])
    assert loaded.periods[-1].true_tip.point == (*then["tip_true_mm"], 0.0)


def test_its_state_is_that_of_a_needle_of_today(loaded, plan_then):
    """Carried out again: the bevel on the side where it was, base and guide where the plan has them."""
    simulator = flexneedle.Simulator(loaded.scenario, threads=1)
    state = simulator.start(loaded.plan.roll)
    flips = np.array(plan_then["controls"])[:, 4]
    sides = plan_then["bevel"] * np.cumprod(np.where(flips > 0.0, -1.0, 1.0))
    assert state.bevel == plan_then["bevel"] == -1
    for k, row in enumerate(loaded.plan.controls):
        state = simulator.step(state, flexneedle.Control.of(row))
        assert state.bevel.real == sides[k]
        assert state.guide == pytest.approx(tuple(loaded.plan.guide[k + 1]), abs=1e-12)
        np.testing.assert_allclose(state.base, loaded.plan.shapes[k + 1, 0], atol=1e-9)
        np.testing.assert_allclose(state.tip, loaded.plan.tips[k + 1], atol=0.02)


# ---- its plan


def test_every_number_of_the_plan_is_in_its_column(loaded, plan_then):
    plan = loaded.plan
    *moves, flips = np.transpose(plan_then["controls"])
    np.testing.assert_array_equal(planar(plan.controls, 0, 1, 3, 5, 7)[:, :4].T, moves)
    np.testing.assert_array_equal(plan.controls[:, 7], np.where(flips > 0.0, np.pi, 0.0))
    np.testing.assert_array_equal(planar(plan.tips, 0, 1, 3), plan_then["tips"])
    np.testing.assert_array_equal(planar(plan.shapes, 0, 1, 3), plan_then["shapes"])
    np.testing.assert_array_equal(planar(plan.guide, 0)[:, 0], plan_then["guide"])
    np.testing.assert_array_equal(plan.strain_energy, plan_then["strain_energy"])
    assert plan.target == (*plan_then["target"], 0.0)
    assert plan.roll == np.pi
    same = ("strategy", "seed", "cost", "terms", "iterations", "converged", "limit")
    assert [getattr(plan, name) for name in same] == [plan_then[name] for name in same]
    assert list(plan.history) == plan_then["history"]


@pytest.mark.parametrize(("bevel", "roll"), [(1, 0.0), (-1, np.pi)])
def test_a_side_of_the_bevel_is_an_angle(plan_then, bevel, roll):
    assert plan_from_values(plan_then | {"bevel": bevel}).roll == roll


def test_a_planar_plan_without_steps_is_read(plan_then):
    assert plan_from_values(plan_then | {"controls": []}).controls.shape == (0, 9)


def test_a_plan_of_today_is_not_converted(loaded):
    values = plan_values(loaded.plan)
    assert plan_values(plan_from_values(values)) == values
    assert plan_values(plan_from_values(json.loads(json.dumps(values)))) == values


def test_a_planar_plan_stays_as_it_was_given(plan_then):
    before = json.dumps(plan_then)
    plan_in_space(plan_then)
    assert json.dumps(plan_then) == before


# ---- its periods


def test_every_column_of_a_row_is_restored_to_the_last_bit(loaded, rows_then):
    """Those that there were; of the others each is 0, or an angle of the bevel."""
    assert len(rows_then) == len(loaded.periods)
    for then, period in zip(rows_then, loaded.periods, strict=True):
        now = to_row(period)
        kept = {MOVED.get(name, name): text for name, text in then.items() if name not in REPLACED}
        assert {name: now[name] for name in kept} == kept
        assert set(now) == set(COLUMNS)
        angles = {"roll_rad", "command_roll_rad", "applied_roll_rad"}
        unknown = {"miss_z_mm"} if then["miss_mm"] == "nan" else set()
        assert {now[name] for name in set(now) - set(kept) - angles - unknown - {"late"}} == {"0.0"}
        assert now["late"] == "False"
        assert {now[name] for name in unknown} <= {"nan"}
        assert np.cos(period.roll) == int(then["bevel"])
        for name in ("command", "applied"):
            turn = np.pi if then[f"{name}_flip"] == "1" else 0.0
            assert (getattr(period, name).roll, getattr(period, name).spin) == (turn, 0.0)
    assert {then["bevel"] for then in rows_then} == {"1", "-1"}
    assert "" in {then["measured_x_mm"] for then in rows_then}


def test_a_predicted_miss_of_then_is_along_y(rows_then, loaded):
    shape = loaded.periods[0].shape
    assert from_row(rows_then[0] | {"miss_mm": "-0.25"}, shape, {}).miss == (-0.25, 0.0)
    np.testing.assert_equal(from_row(rows_then[0] | {"miss_mm": "nan"}, shape, {}).miss, (np.nan, np.nan))


def test_shapes_are_planar(folder, loaded):
    for message, period in zip(messages(folder, "/needle/shape"), loaded.periods, strict=True):
        poses = [stamped.pose for stamped in message.poses]
        shape = planar(period.shape, 0, 1, 3)
        np.testing.assert_array_equal(shape[:, 0], [pose.position.x * 1e3 for pose in poses])
        np.testing.assert_array_equal(shape[:, 1], [pose.position.y * 1e3 for pose in poses])
        half = [np.arctan2(pose.orientation.z, pose.orientation.w) for pose in poses]
        np.testing.assert_allclose(shape[:, 2], np.multiply(half, 2.0), rtol=1e-15)
        assert (period.predicted, period.true_shape) == (None, None)


def test_readings_are_kept(loaded):
    assert [len(period.readings) for period in loaded.periods] == [4, 4, 5, 4, 4, 4, 6, 1]
    assert loaded.periods[0].action is Action.MOVE
    for period in loaded.periods:
        if period.verdict.ok:
            good = [one.measurement for one in period.readings if one.verdict.ok]
            newest = (good[-1].time, good[-1].x, good[-1].y)
            measured = period.measurement
            assert newest == (measured.time, measured.x, measured.y)


def test_a_planar_period_without_a_true_tip_has_none(rows_then, loaded):
    """On a rig; and one in which the tracker saw nothing."""
    blank = {name: "" for name in rows_then[0] if name.startswith("true_")}
    period = from_row(rows_then[0] | blank, loaded.periods[0].shape, {})
    assert (period.true_tip, period.true_strain_energy, period.true_stretch) == (None, None, None)
    assert period.estimate == loaded.periods[0].estimate


def test_a_row_of_the_earliest_names_is_read(rows_then, loaded):
    """There the columns of the measurement began with `sample_`."""
    earliest = {name.replace("measured_", "sample_"): text for name, text in rows_then[0].items()}
    assert "sample_x_mm" in earliest
    period = from_row(earliest, loaded.periods[0].shape, {})
    assert to_row(period) == to_row(loaded.periods[0])


def test_a_row_of_today_is_not_converted(loaded):
    row = to_row(loaded.periods[1])
    assert row_in_space(row) == row


@pytest.mark.parametrize("name", ["bevel", "command_flip", "tip_load_n", "true_y_mm", "base_theta_rad"])
def test_a_planar_row_that_lacks_a_column_is_refused(rows_then, loaded, name):
    """As any damaged one: by a KeyError, which ends the reading of a trace."""
    row = {key: text for key, text in rows_then[0].items() if key != name}
    with pytest.raises(KeyError):
        from_row(row, loaded.periods[0].shape, {})


def test_written_again_it_is_a_record_of_today(loaded, tmp_path):
    with TraceWriter(tmp_path / "trace.mcap", loaded.plan, about={"seed": "3"}, scenario={}) as writer:
        for period in loaded.periods:
            writer.add(period)
    again = read_trace(tmp_path / "trace.mcap").periods
    assert [to_row(period) for period in again] == [to_row(period) for period in loaded.periods]
    for one, other in zip(again, loaded.periods, strict=True):
        np.testing.assert_allclose(one.shape, other.shape, rtol=1e-14, atol=1e-14)
        assert isinstance(one.estimate, Pose)
