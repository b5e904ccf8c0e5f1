"""Statistics of a supervisor's ticks: durations, missed ticks, and changes of the state."""

import math

import pytest

from flexneedle.lab.rig.supervised import TickStatistics
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.protocol import AxisState, TickReport
from flexneedle.ports import MotorState


def summary(*reports):
    found = TickStatistics(started=100.0)
    for report in reports:
        found.add(report)
    return found.summarize()


def inserting(time, **options):
    return TickReport(time, SupervisorState.INSERTING, **options)


def test_delays_durations_and_stalls_of_ticks_are_summed():
    """A stall is at the tick after the missed ones."""
    found = summary(inserting(1.0, late=0.004, work=0.001), inserting(1.1, late=0.075, work=0.003, missed=3))
    assert (found["late_max_ms"], found["work_max_ms"]) == pytest.approx((75.0, 3.0))
    assert (found["ended_p50_ms"], found["ended_max_ms"]) == pytest.approx((41.5, 78.0))
    assert (found["count"], found["missed"]) == (2, 3)
    assert found["stalls"] == [{"time_s": pytest.approx(101.1), "late_s": 0.075}]
    assert summary()["ended_p99_ms"] is None


def test_the_time_of_a_state_is_the_end_of_its_tick_since_a_fault_may_occur_within_the_tick():
    fault = TickReport(1.05, SupervisorState.FAULT, "the motor is off", work=0.004)
    found = summary(inserting(1.0, work=0.002), inserting(1.025, work=0.002), fault)["states"]
    assert [(one["state"], one["why"]) for one in found] == [("inserting", ""), ("fault", "the motor is off")]
    assert [one["time_s"] for one in found] == pytest.approx([101.002, 101.054])


def test_the_largest_motion_in_the_queue_is_kept_by_axis():
    rest = MotorState(0.0, 0.0)
    reports = [
        inserting(0.0, axes={"insertion": AxisState(0.0, rest, way), "rotation": AxisState(0.0, rest, angle)})
        for way, angle in ((0.3, 0.1), (0.2, 0.4))
    ]
    assert summary(*reports)["queued"] == pytest.approx(
        {"insertion_mm": 0.3, "rotation_deg": math.degrees(0.4)}
    )
