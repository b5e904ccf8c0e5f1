"""Every public record prints as one short line with units, without its arrays."""

from dataclasses import replace

import numpy as np
import pytest

import flexneedle
from flexneedle.control.controllers import CONTROLLERS, DEFAULT
from flexneedle.estimation.identification import Identification
from flexneedle.estimation.observer import StateCorrection
from flexneedle.phantom.draw import draw
from flexneedle.types import Frame, SensorReading
from synthetic import make_insertion, make_plan
from tasks import begun_with, task_of

LONGEST = 300  # characters
SCENARIO = flexneedle.load_scenario("phantom")
SIMULATOR = flexneedle.Simulator(SCENARIO, threads=2)
STATE = SIMULATOR.step(SIMULATOR.start(), flexneedle.Control(db_x=1.0, dg_y=0.1))
INSERTION = make_insertion()
ROLLOUT = SIMULATOR.rollout(STATE, [[flexneedle.Control(db_x=1.0)] * 3] * 2)
READINGS = {"tip": SensorReading((1.0, 2.0, 3.0)), "ref1": SensorReading(None, status="missing")}
RECORDS = {
    "plan": INSERTION.plan,
    "insertion": INSERTION,
    "insertion that was held": make_insertion(outcome="held", reason="no sample for 1.00 s", periods=3),
    "insertion without a period": replace(INSERTION, periods=()),
    "period": INSERTION.periods[10],
    "frame": Frame(0.3, 12, READINGS),
    "scenario": SCENARIO,
    "simulator": SIMULATOR,
    "state": STATE,
    "start": SIMULATOR.start(),
    "contacts": STATE.contacts,
    "assimilation": SIMULATOR.assimilate(STATE, STATE.tip[:2]),
    "trajectories": ROLLOUT,
    "task": task_of(SIMULATOR, make_plan()),
    "estimate": StateCorrection().begin(begun_with(SIMULATOR)),
    "identification": Identification().begin(begun_with(SIMULATOR)),
    "controller": CONTROLLERS[DEFAULT],
    "truth": draw(SCENARIO, np.random.default_rng(0)),
}


@pytest.mark.parametrize("name", RECORDS)
def test_a_record_prints_as_one_short_line(name):
    for text in (repr(RECORDS[name]), str(RECORDS[name])):
        assert "\n" not in text
        assert "array(" not in text
        assert len(text) <= LONGEST, text


def test_a_state_gives_the_slope_in_mrad():
    solution = STATE.needle.solution
    sloped = STATE.needle._replace(solution=solution._replace(tip=solution.tip._replace(slope=2e-3)))
    assert "slope 2.00 mrad" in repr(replace(STATE, solved=STATE.solved.with_needle(sloped)))


def test_a_plan_and_an_insertion_give_the_target_as_the_terminal_does():
    plan = replace(INSERTION.plan, target=(138.126, 2.6789, 0.0))
    for record in (plan, replace(INSERTION, plan=plan)):
        assert "to (138.126, 2.679) mm" in repr(record)
