"""Sensors along the needle in the record: restored exactly, and in tables; a run without them has none of it."""

import csv
import math
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from mcap.reader import make_reader

import flexneedle
from flexneedle.record.export import write_csv, write_sensor_readings
from flexneedle.record.fields import COLUMNS
from flexneedle.record.topics import OPTIONAL, period_messages
from synthetic import make_insertion
from synthetic_sensors import COVARIANCE, EXCLUDED_FROM, FROZEN, with_sensors

PLAIN = replace(make_insertion(), scenario=flexneedle.load_scenario("phantom"), controller="adaptive-mpc")
SENSED = with_sensors(PLAIN)

pytestmark = pytest.mark.usefixtures("drawing")


def topics(folder):
    """Return the topics with their types of a trace."""
    with (folder / "trace.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    return {one.topic: summary.schemas[one.schema_id].name for one in summary.channels.values()}


def rows_of(write, insertion):
    file = StringIO(newline="")
    write(file, insertion)
    return list(csv.DictReader(file.getvalue().splitlines()))


def test_sensors_and_the_covariance_are_restored_exactly(tmp_path):
    loaded = flexneedle.load(flexneedle.save(SENSED, tmp_path / "run"))
    for period, restored in zip(SENSED.periods, loaded.periods, strict=True):
        assert repr(restored.sensors) == repr(period.sensors)  # NaN and the sign of a zero, too
        assert restored.tip_covariance == period.tip_covariance
    assert topics(tmp_path / "run").keys() >= set(OPTIONAL)


def test_a_run_without_sensors_has_no_topics_and_columns_of_them(tmp_path):
    loaded = flexneedle.load(flexneedle.save(PLAIN, tmp_path / "run"))
    assert {(period.sensors, period.tip_covariance) for period in loaded.periods} == {((), None)}
    assert not topics(tmp_path / "run").keys() & set(OPTIONAL)
    assert tuple(rows_of(write_csv, PLAIN)[0]) == COLUMNS
    assert rows_of(write_sensor_readings, PLAIN) == []


def test_a_sensor_that_is_missing_in_some_periods_is_not_that_of_the_period_before(tmp_path):
    mixed = replace(SENSED, periods=(SENSED.periods[0], PLAIN.periods[1], SENSED.periods[2]))
    loaded = flexneedle.load(flexneedle.save(mixed, tmp_path / "run"))
    assert [len(period.sensors) for period in loaded.periods] == [2, 0, 2]


def test_the_covariance_is_published_in_si_units(tmp_path):
    flexneedle.save(SENSED, tmp_path / "run")
    assert topics(tmp_path / "run")["/tip/covariance"] == "geometry_msgs/msg/PoseWithCovarianceStamped"
    (found,) = (one.message for one in period_messages(SENSED.periods[0]) if one.topic == "/tip/covariance")
    np.testing.assert_allclose(found.pose.covariance.reshape(6, 6)[:3, :3], 1e-6 * np.array(COVARIANCE))


def test_the_table_of_periods_has_sd_of_the_tip_and_state_of_each_sensor():
    rows = rows_of(write_csv, SENSED)
    assert [*rows[0]][len(COLUMNS) :] == [
        *("tip_sd_x_mm", "tip_sd_y_mm", "tip_sd_z_mm"),
        *("fbg.nis", "fbg.verdict", "slice.nis", "slice.verdict"),
    ]
    assert [float(rows[5][f"tip_sd_{axis}_mm"]) for axis in "xyz"] == pytest.approx([0.01, 0.02, 0.03])
    assert float(rows[2]["fbg.nis"]) == 0.1 * 3 / 3
    assert rows[EXCLUDED_FROM - 1]["fbg.verdict"] == "ok"
    assert rows[EXCLUDED_FROM]["fbg.verdict"] == FROZEN
    assert math.isnan(float(rows[0]["slice.nis"]))


def test_the_data_frame_has_the_same_columns():
    pytest.importorskip("pandas")
    table = flexneedle.to_dataframe(SENSED)
    assert list(table.columns) == [*rows_of(write_csv, SENSED)[0]]
    assert table["tip_sd_y_mm"].to_numpy() == pytest.approx(0.02)


def test_the_table_of_readings_has_one_line_per_reading():
    sensors = {"sensor": [{"kind": "fbg", "sites_mm": [11, 26]}, {"kind": "slice", "plane_mm": 20.0}]}
    insertion = replace(SENSED, scenario=SENSED.scenario.with_values(sensors))
    rows = rows_of(write_sensor_readings, insertion)
    assert len(rows) == 2 * len(SENSED.periods)
    assert [row["unit"] for row in rows[:2]] == ["1/mm", "mm"]
    assert rows_of(write_sensor_readings, replace(SENSED, scenario=None))[0]["unit"] == ""
    bent, missed = rows[:2]
    assert (bent["sensor"], bent["verdict"], bent["rows"]) == ("fbg", "ok", f"0.001 -0.0; nan {1 / 3e3!r}")
    assert (missed["status"], missed["verdict"], missed["rows"]) == ("no needle", "missing: no needle", "")
    assert rows[2 * EXCLUDED_FROM]["verdict"] == "excluded"
