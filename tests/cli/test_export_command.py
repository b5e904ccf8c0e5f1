"""`flexneedle export`: tables of periods and of readings."""

import csv
from dataclasses import replace

import pytest

import fake_engine
from commands import run
from flexneedle.record.fields import COLUMNS
from flexneedle.record.reader import read_trace
from flexneedle.types import CheckedMeasurement
from synthetic import make_periods
from synthetic_readings import with_readings

pytestmark = pytest.mark.usefixtures("in_tmp", "drawing")


def test_export_writes_one_line_per_period_with_units(engine, capsys, in_tmp):
    engine()
    run(capsys, "insert", "--out", "here")
    assert run(capsys, "export", "here", "--csv") == (0, "here/periods.csv\n", "")
    run(capsys, "export", "here", "--csv", "other.csv")
    text = (in_tmp / "here/periods.csv").read_text()
    assert text == (in_tmp / "other.csv").read_text()
    rows = list(csv.DictReader(text.splitlines()))
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == 23
    assert float(rows[-1]["true_x_mm"]) == 40.0
    assert rows[-1]["guide_y_mm"].count(".") == 1


@pytest.fixture
def watched_engine(engine, monkeypatch):
    """Install a fake loop that reads a tracker with references; the second one is missing at first."""

    def make(*options):
        for period in make_periods(*options):
            lost = period.index == 0
            yield with_readings(period, (lambda _: None) if lost else (lambda time: 0.1 * time))

    monkeypatch.setattr(fake_engine, "make_periods", make)
    engine()


@pytest.mark.usefixtures("watched_engine")
def test_export_writes_one_line_per_reading_with_all_sensors(capsys, in_tmp):
    run(capsys, "insert", "--out", "here")
    assert run(capsys, "export", "here", "--readings") == (0, "here/readings.csv\n", "")
    run(capsys, "export", "here", "--readings", "other.csv")
    text = (in_tmp / "here/readings.csv").read_text()
    assert text == (in_tmp / "other.csv").read_text()
    assert run(capsys, "export", "here", "--readings", "-") == (0, text, "")
    rows = list(csv.DictReader(text.splitlines()))
    sensor = ["x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz", "indicator", "status"]
    assert list(rows[0]) == [
        *("time_s", "period", "frame_number", "verdict", "x_mm", "y_mm", "z_mm"),
        *(f"{name}.{part}" for name in ("tip", "ref1", "ref2", "ref3") for part in sensor),
    ]
    assert [int(row["frame_number"]) for row in rows] == list(range(8 * 23))
    assert [int(row["period"]) for row in rows] == [k // 8 for k in range(8 * 23)]
    last = rows[-1]
    period = read_trace(in_tmp / "here/trace.mcap").periods[-1]
    assert float(last["time_s"]) == period.readings[-1].measurement.time
    assert (float(last["x_mm"]), float(last["y_mm"])) == (period.measurement.x, period.measurement.y)
    tip = [last[f"tip.{part}"] for part in sensor]
    assert tip == ["1.0", "2.0", "3.0", "1.0", "0.0", "0.0", "0.0", "", "ok"]
    assert float(last["ref2.indicator"]) == 0.1 * float(last["time_s"])
    assert last["verdict"] == "ok"
    assert [rows[0][f"ref2.{part}"] for part in sensor] == [""] * 8 + ["missing"]


def test_other_measurements_than_the_tip_have_separate_columns(engine, monkeypatch, capsys):
    measured = {
        "direction": (0.125, -0.25),
        "covariance": ((1.0, 0.5, 0.0), (0.5, 1.0, 0.0), (0.0, 0.0, 1.0)),
    }

    def make(*options):
        for period in make_periods(*options):
            both = (period.measurement, replace(period.measurement, **measured))
            yield replace(period, readings=tuple(CheckedMeasurement(one, period.verdict) for one in both))

    monkeypatch.setattr(fake_engine, "make_periods", make)
    engine()
    run(capsys, "insert", "--out", "here")
    bare, full, *_ = csv.DictReader(run(capsys, "export", "here", "--readings", "-")[1].splitlines())
    names = ["direction_theta_rad", "direction_psi_rad", "covariance_mm2"]
    assert list(full)[-4:] == ["z_mm", *names]
    assert [full[name] for name in names] == ["0.125", "-0.25", "1.0 0.5 0.0; 0.5 1.0 0.0; 0.0 0.0 1.0"]
    assert [bare[name] for name in names] == ["", "", ""]


def test_a_tracker_without_frames_exports_the_tip_alone_and_a_missing_folder_is_refused(engine, capsys):
    engine()
    run(capsys, "insert", "--out", "here")
    header = "time_s,period,frame_number,verdict,x_mm,y_mm,z_mm\n"
    assert run(capsys, "export", "here", "--readings", "-") == (0, header, "")
    for what in ("--csv", "--readings"):
        status, out, err = run(capsys, "export", "here", what, "nodir/foo.csv")
        assert (status, out) == (2, "")
        assert err.startswith("flexneedle: nodir/foo.csv: cannot be written: ")


def test_a_plan_cannot_be_exported(engine, capsys):
    engine()
    run(capsys, "plan", "--out", "here")
    status, _, err = run(capsys, "export", "here", "--csv")
    assert (status, err) == (2, "flexneedle: here: contains a plan, not an insertion\n")
