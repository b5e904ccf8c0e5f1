"""The record of a supervisor's ticks: how long they took, which were left out, and when the state changed."""

import math

import pytest

from flexneedle.lab.rig.supervised import TickStatistics
from flexneedle.lab.rig.supervisor.machine import SupervisorState
from flexneedle.lab.rig.supervisor.protocol import AxisState, TickReport
from flexneedle.ports import MotorState

REST = MotorState(0.0, 0.0)


def ticks(*reports):
    found = TickStatistics(started=100.0)
    for report in reports:
        found.add(report)
    return found.summarize()


def test_late_and_work_are_summed_for_each_tick():
    found = ticks(
        TickReport(0.0, SupervisorState.ARMED, late=0.004, work=0.001),
        TickReport(0.025, SupervisorState.ARMED, late=0.0, work=0.003),
    )
    assert (found["late_max_ms"], found["work_max_ms"]) == pytest.approx((4.0, 3.0))
    assert (found["ended_p50_ms"], found["ended_max_ms"]) == pytest.approx((4.0, 5.0))


def test_a_state_has_the_time_at_which_its_tick_ended_since_a_fault_may_come_within_the_tick():
    found = ticks(
        TickReport(1.0, SupervisorState.INSERTING, work=0.002),
        TickReport(1.025, SupervisorState.INSERTING, work=0.002),
        TickReport(1.05, SupervisorState.FAULT, "the motor is off", work=0.004),
    )
    assert [(one["state"], one["why"]) for one in found["states"]] == [
        ("inserting", ""),
        ("fault", "the motor is off"),
    ]
    assert [one["time_s"] for one in found["states"]] == pytest.approx([101.002, 101.054])


def test_a_stall_is_at_the_tick_before_which_others_were_left_out():
    found = ticks(
        TickReport(1.0, SupervisorState.ARMED), TickReport(1.1, SupervisorState.ARMED, late=0.075, missed=3)
    )
    assert (found["count"], found["missed"]) == (2, 3)
    assert found["stalls"] == [{"time_s": pytest.approx(101.1), "late_s": 0.075}]


def test_the_largest_motion_in_the_queue_is_kept_by_axis():
    queues = [(0.3, 0.1), (0.2, 0.4)]
    reports = [
        TickReport(
            0.0,
            SupervisorState.INSERTING,
            axes={"insertion": AxisState(0.0, REST, way), "rotation": AxisState(0.0, REST, angle)},
        )
        for way, angle in queues
    ]
    assert ticks(*reports)["queued"] == pytest.approx(
        {"insertion_mm": 0.3, "rotation_deg": math.degrees(0.4)}
    )


def test_without_ticks_there_are_no_times():
    assert ticks()["ended_p99_ms"] is None
