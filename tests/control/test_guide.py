"""Motion of the guide, and the controllers that are refused without it."""

import numpy as np
import pytest

import flexneedle
from flexneedle.control import mpc
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.control.limits import check_guide, guide_may_move, largest_guide_step
from flexneedle.control.mpc import CeMpc
from flexneedle.errors import InputError
from flexneedle.loop.choices import Choices
from flexneedle.record.folder import Folder
from flexneedle.record.recording import record_insertion
from flexneedle.simulator.simulator import Simulator

PHANTOM = flexneedle.load_scenario("phantom")
BARE = PHANTOM.with_values({"setup.guide_to_skin_mm": None})
GUIDE_CONTROLLERS = ("resolved-rate", "broyden-mpc")


QUICK = PHANTOM.with_values({"plan.samples": 32, "plan.iterations": 4, "plan.max_iterations": 4})


@pytest.fixture(scope="module")
def steered():
    """A plan in which the bevel alone steers."""
    return flexneedle.plan(QUICK, (30.0, 0.5), "steering", threads=1)


@pytest.mark.parametrize(
    ("scenario", "strategy", "free"),
    [(PHANTOM, "manipulation", True), (PHANTOM, "steering", False), (BARE, "manipulation", False)],
)
def test_the_guide_may_move_where_there_is_one_and_the_plan_does_not_leave_it_still(scenario, strategy, free):
    assert guide_may_move(scenario.setup, strategy) is free
    assert largest_guide_step(scenario.setup, strategy) == (0.5 if free else 0.0)


@pytest.mark.parametrize("name", list(CONTROLLERS))
def test_only_controllers_of_the_guide_are_refused_without_one(name):
    check_guide(CONTROLLERS[name], PHANTOM.setup, "manipulation")
    if name not in GUIDE_CONTROLLERS:
        check_guide(CONTROLLERS[name], BARE.setup, "manipulation")
        check_guide(CONTROLLERS[name], PHANTOM.setup, "steering")
        return
    with pytest.raises(InputError, match=rf"'{name}'.*setup\.guide_to_skin_mm"):
        check_guide(CONTROLLERS[name], BARE.setup, "manipulation")
    with pytest.raises(InputError, match=rf"'{name}'.*strategy = 'steering'"):
        check_guide(CONTROLLERS[name], PHANTOM.setup, "steering")


def test_the_refusal_comes_before_the_plan(tmp_path):
    folder = Folder.claim(tmp_path / "run", "run", "insertion", PHANTOM, 0)
    choices = Choices.of(0, "resolved-rate")

    def never(*_):
        raise AssertionError("planned")

    with pytest.raises(InputError, match="resolved-rate"):
        record_insertion(folder, PHANTOM, "steering", choices, listeners=[never])


def test_ce_mpc_leaves_the_guide_where_it_is(steered, along):
    """The base clamp is off; otherwise the controller would move the guide."""
    state = along(steered, 40, base=(1.0,))
    choice = mpc.choose_step(
        Simulator(PHANTOM, 1), steered, state, CeMpc(), roll=0.0, rng=np.random.default_rng(0)
    )
    assert choice.command.dg_y == 0.0
    assert choice.spread == 0.0


@pytest.mark.parametrize(
    "name", ["ce-mpc", *(pytest.param(one, marks=pytest.mark.long) for one in ("bevel-only", "open-loop"))]
)
def test_a_steering_plan_is_carried_out_with_the_guide_still(name, steered):
    rig = flexneedle.VirtualRig("model")
    done = flexneedle.insert(QUICK, steered, 5000, controller=name, rig=rig, threads=1)
    assert done.outcome == "done"
    assert {period.applied.dg_y for period in done.periods} == {0.0}
