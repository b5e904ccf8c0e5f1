"""Speeds that `rig check` prints, compared with motions of the supervisor."""

import pytest

from flexneedle.lab.rig.preflight.speeds import attained_speed, describe_speed, step_time
from flexneedle.lab.rig.supervisor import protocol
from stages import TICK_S, Bench, rig_file


def slow(speed, acceleration):
    return rig_file(insertion={"speed_mm_s": speed, "acceleration_mm_s2": acceleration})


@pytest.mark.parametrize(("speed", "acceleration"), [(10.0, 200.0), (10.0, 50.0), (10.0, 10.0), (5.0, 5.0)])
def test_an_axis_keeps_the_speed_that_it_can_brake_from_within_the_queue(speed, acceleration):
    rig = slow(speed, acceleration)
    bench = Bench(rig).armed()
    bench.core.request(protocol.MoveCommand(1, "insertion", 30.0, speed))
    times = []
    for place in (12.0, 18.0):
        while bench.position("insertion") < place:
            bench.tick()
        times.append(len(bench.reports) * TICK_S)
    measured = 6.0 / (times[1] - times[0])
    assert attained_speed(rig.axes.insertion, rig.loop, speed) == pytest.approx(measured, rel=0.1)


@pytest.mark.parametrize("acceleration", [200.0, 50.0, 10.0, 5.0, 1.0])
def test_a_step_takes_the_time_that_its_acceleration_needs(acceleration):
    rig = slow(10.0, acceleration)
    bench = Bench(rig).armed()
    bench.core.request(protocol.StepCommand(1, 0.0, {"insertion": 1.0}, 0.2))
    assert bench.until(1).why == ""
    taken = bench.clock.now()
    assert step_time(rig.axes.insertion, rig.loop, 1.0, 0.2) == pytest.approx(taken, rel=0.1, abs=2 * TICK_S)


def test_a_speed_that_an_axis_does_not_keep_is_printed_with_its_reason():
    rig = slow(10.0, 50.0)
    assert {name: describe_speed(rig, axis) for name, axis in rig.axes.items()} == {
        "insertion": "5.93 of 10 mm/s: acceleration_mm_s2 = 50 cannot brake a faster axis within the queue",
        "rotation": "360 deg/s",
        "guide_y": "10 mm/s",
    }
