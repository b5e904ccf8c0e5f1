"""The paper's experiment in a simulated environment: its table, and the effect of the seeds."""

from collections import Counter

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flexneedle.errors import InputError
from flexneedle.lab.tables.columns import COLUMNS
from flexneedle.lab.tables.write import write_table
from flexneedle.lab.tracker_evaluation.simulate import Experiment, measure_grid
from flexneedle.scenario.files import load_environment
from rooms import environment

SMALL = Experiment(points=2, samples=3, repeats=4)
ROWS = 2 * 2**3 * 3 * 4


def column(table, name, sensor="tip"):
    return table[name][table["sensor"] == sensor]


def test_the_papers_experiment_is_500_samples_at_each_of_125_points():
    """5 × 5 × 5 points in 1000 cm³, 100 samples, 5 times, two sensors, two environments."""
    table = measure_grid([load_environment("ideal"), load_environment("noisy")], Experiment())
    assert tuple(table) == COLUMNS
    counts = Counter(
        zip(*(table[name].tolist() for name in ("environment", "sensor", "point_id")), strict=True)
    )
    assert set(counts.values()) == {500}
    assert len(counts) == 2 * 2 * 125
    for axis in "xyz":
        assert np.unique(column(table, f"true_{axis}_mm")).tolist() == [-50.0, -25.0, 0.0, 25.0, 50.0]


def test_a_tracker_without_errors_measures_the_grid():
    table = measure_grid([environment()], SMALL)
    for sensor in ("tip", "reference"):
        for axis in "xyz":
            true, measured = column(table, f"true_{axis}_mm", sensor), column(table, f"{axis}_mm", sensor)
            np.testing.assert_allclose(measured, true, atol=1e-12)
    assert column(table, "indicator", "reference").tolist() == pytest.approx([0.0] * (ROWS // 2))
    assert np.isnan(column(table, "indicator", "tip")).all()


def test_each_repeat_visits_the_grid_and_takes_all_samples_of_a_point_at_once():
    ids = column(measure_grid([environment()], SMALL), "point_id")
    np.testing.assert_array_equal(ids, np.tile(np.repeat(np.arange(8), 3), 4))


def test_the_tip_sensor_points_along_x_and_the_reference_along_z():
    table = measure_grid([environment()], SMALL)
    for sensor, axis in (("tip", [1.0, 0.0, 0.0]), ("reference", [0.0, 0.0, 1.0])):
        quaternions = np.stack([column(table, name, sensor) for name in ("qw", "qx", "qy", "qz")], axis=1)
        measured = Rotation.from_quat(quaternions, scalar_first=True).apply([0.0, 0.0, 1.0])
        np.testing.assert_allclose(measured, np.tile(axis, (len(measured), 1)), atol=1e-12)


def test_a_missing_sample_has_no_position_indicator_or_orientation():
    table = measure_grid([environment(missing_fraction=0.3)], Experiment(points=3, samples=50))
    lost = np.isnan(table["x_mm"])
    assert lost.mean() == pytest.approx(0.3, rel=0.05)
    for name in ("y_mm", "z_mm", "indicator", "qw", "qx", "qy", "qz"):
        assert np.isnan(table[name][lost]).all()
    assert not np.isnan(table["true_x_mm"]).any()
    assert not np.isnan(table["qw"][~lost]).any()


# ---- seeds


def test_the_seed_draws_the_noise_and_the_field_seed_the_field_errors():
    clear = environment(tip={"bias_mm": 1.0, "jitter_mm": 0.1})

    def bias(**seeds):
        table = measure_grid([clear], Experiment(points=2, samples=2000, repeats=1, **seeds))
        off = column(table, "x_mm") - column(table, "true_x_mm")
        return off.reshape(8, 2000).mean(axis=1)

    np.testing.assert_allclose(bias(seed=1), bias(seed=2), atol=0.01)
    assert (bias(seed=1) != bias(seed=2)).all()
    assert np.abs(bias(field_seed=3) - bias()).max() > 0.1
    np.testing.assert_array_equal(bias(field_seed=clear.field_seed), bias())


def test_an_environments_rows_do_not_depend_on_what_else_is_measured():
    ideal, noisy = load_environment("ideal"), load_environment("noisy")
    alone, both = measure_grid([noisy], SMALL), measure_grid([ideal, noisy], SMALL)
    for name in COLUMNS:
        np.testing.assert_array_equal(both[name][ROWS:], alone[name])
    assert not np.allclose(*(column(table, "y_mm")[:5] for table in (both, alone)))
    noise = environment(tip={"jitter_mm": 0.1}, reference={"jitter_mm": 0.1}, tilt_jitter_mrad=0.0)
    table = measure_grid([noise], Experiment(points=2, samples=500))
    off = [column(table, "x_mm", name) - column(table, "true_x_mm", name) for name in ("tip", "reference")]
    assert abs(np.corrcoef(off)[0, 1]) < 0.05


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_same_seed_same_bytes(tmp_path, suffix):
    files = [tmp_path / f"{name}{suffix}" for name in ("one", "same", "other")]
    for file, seed in zip(files, (5, 5, 6), strict=True):
        write_table(
            measure_grid([load_environment("noisy")], Experiment(seed, points=2, samples=3, repeats=4)), file
        )
    one, same, other = (file.read_bytes() for file in files)
    assert one == same != other


def test_two_environments_of_one_name_and_too_many_samples_are_refused():
    with pytest.raises(InputError, match="two environments have the name ideal"):
        measure_grid([load_environment("ideal")] * 2, SMALL)
    with pytest.raises(InputError, match="200000000 samples: must be at most"):
        measure_grid([load_environment("ideal")], Experiment(points=10, samples=100_000, repeats=1))
