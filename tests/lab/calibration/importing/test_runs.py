"""Run folders of the package: no map, and guide, base and roll at the time of each reading."""

import dataclasses

import numpy as np
import pytest

import flexneedle
from flexneedle.errors import InputError
from flexneedle.lab.calibration.importing.importer import import_recordings
from flexneedle.lab.calibration.session import load_session
from flexneedle.types import DB_Y, DG_Y, ROLL
from recorded_insertions import columns, guided, load, write_csv

ROLLED, MOVED, SHIFTED = 20, 30, 40  # steps in which the needle, the guide and the base move
TARGETS = {"phantom": (20.0, 1.0), "phantom3d": (20.0, 1.0, 0.5)}


def carry_out(scenario):
    """Return an insertion in open loop whose roll, guide and base each move in one step."""
    plan = flexneedle.plan(scenario, target=TARGETS[scenario], seed=0)
    controls = plan.controls.copy()
    controls[:, ROLL] = controls[:, DG_Y] = controls[:, DB_Y] = 0.0
    controls[ROLLED, ROLL], controls[MOVED, DG_Y], controls[SHIFTED, DB_Y] = np.pi, 0.5, -0.25
    plan = dataclasses.replace(plan, controls=controls)
    return flexneedle.insert(scenario, plan, controller="open-loop", seed=0, force=True)


@pytest.fixture(scope="module", params=[*TARGETS])
def run(request, tmp_path_factory):
    done = carry_out(request.param)
    folder = tmp_path_factory.mktemp(request.param) / "gel 1"
    flexneedle.save(done, folder)
    return folder, done


def test_a_run_needs_no_map(run, tmp_path):
    folder, done = run
    (found,) = import_recordings([folder]).session.recordings
    axes = done.scenario.setup.axes
    assert (found.name, found.session, found.axes) == ("gel 1", folder.parent.name, axes)
    true = np.array([period.true_tip.point for period in done.periods])
    ends = [period.time for period in done.periods]
    at = np.stack([np.interp(found.time[1:], ends, each) for each in true.T], axis=1)
    np.testing.assert_allclose(found.depth[1:], at[:, 0], atol=1.0)  # a period that rolls advances at its end
    assert np.median(np.abs(found.depth[1:] - at[:, 0])) < 0.15
    np.testing.assert_allclose(
        np.diff(found.position, axis=0)[1:], np.diff(at[:, 1 : 1 + axes], axis=0), atol=0.6
    )
    import_recordings([folder]).session.save(tmp_path)
    assert load_session(tmp_path).guide_order == "with"


def test_a_run_has_guide_base_and_roll_at_each_reading(run):
    folder, done = run
    (found,) = import_recordings([folder]).session.recordings
    ends = np.array([period.time for period in done.periods])
    for step, values, size in (
        (ROLLED, found.roll - found.roll[0], np.pi),
        (MOVED, found.guide[:, 0], 0.5),
        (SHIFTED, found.base[:, 0], -0.25),
    ):
        before, after = values[found.time <= ends[step - 1] + 1e-6], values[found.time >= ends[step] - 1e-6]
        assert abs(before[-1]) < 0.05
        assert len(after) > 3
        assert after[0] == pytest.approx(size, rel=0.2)
    assert found.roll[0] == pytest.approx(done.plan.roll)


def test_runs_are_named_by_their_files_too(run):
    folder, _ = run
    for name in ("run.json", "trace.mcap"):
        (found,) = import_recordings([folder / name]).session.recordings
        assert found.name == "gel 1"


def test_runs_and_tables_have_one_order_of_motions(run, tmp_path):
    folder, _ = run
    file = write_csv(tmp_path / "a.csv", columns(guided()))
    with pytest.raises(
        InputError, match=r'moves "with" the advance, and steps\.guide = "before": import runs sep'
    ):
        load(folder, file)
    plane = load_axes(folder)
    both = load(folder, file, steps={"guide": "with"}, frame={"plane": plane == 1}).session
    assert len(both.recordings) == 2
    with pytest.raises(InputError, match=r"lateral axes, and .*: import them separately"):
        load(folder, file, steps={"guide": "with"}, frame={"plane": plane == 2})


def load_axes(folder):
    return import_recordings([folder]).session.axes


def test_a_plan_is_no_recording(tmp_path):
    flexneedle.save(flexneedle.plan("phantom", target=TARGETS["phantom"], seed=0), tmp_path / "plan")
    with pytest.raises(InputError, match="contains a plan, not an insertion"):
        import_recordings([tmp_path / "plan"])
