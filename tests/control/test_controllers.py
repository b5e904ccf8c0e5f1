"""Rules of every controller of the field: limits, mirror symmetry, and an end at the target depth."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

import flexneedle
from controllers import assert_predicted_shapes
from flexneedle.control.controllers import CONTROLLERS
from flexneedle.errors import InputError
from flexneedle.phantom.plants import PLANTS
from flexneedle.simulator.simulator import Simulator
from flexneedle.types import DB_THETA, DB_X, DB_Y, DG_Y, ROLL, STILL, THETA, X, Y
from reference.cases import MIRROR
from tasks import stretched, task_of

# Only the default controller estimates an axial start error.
PHANTOM = flexneedle.load_scenario("phantom").with_values({"phantom.start_axial_sd_mm": 0.0})
FIELD = ("open-loop", "bevel-only", "resolved-rate", "broyden-mpc")
WITHOUT_GUIDE = ("open-loop", "bevel-only")


def drive(name, plan, scenario, estimated, readings, *, steps, plant=None):
    """Commands of a controller whose model is the plant itself and whose readings are a step late, plus `readings`."""
    task = task_of(Simulator(scenario, threads=1), plan, name)
    chosen, simulator = CONTROLLERS[name], Simulator(plant or scenario, threads=1)
    memory, rng = chosen.begin(task), np.random.default_rng(0)
    state, last, commands = simulator.start(plan.roll), None, []
    for off in readings[:steps]:
        measured = None if last is None else tuple((last + np.array([0.0, off, 0.0])).tolist())
        estimate = estimated(replace(state, scenario=scenario), measured=measured, innovation=(0.0, off, 0.0))
        decision, memory = chosen.decide(task, memory, estimate, rng)
        commands.append(decision.command)
        last, state = state.tip[:3], simulator.step(state, decision.command)
        if chosen.arrived(task, memory, estimated(state)):
            break
    return np.array(commands), state


@pytest.mark.long
@given(
    name=st.sampled_from((*FIELD, "ce-mpc")), base=st.floats(-0.6, 0.6), stretch=st.floats(-3.0, 3.0),
    step=st.floats(0.01, 0.5), reach=st.floats(0.02, 15.0), advance=st.floats(0.3, 2.0),
    readings=st.lists(st.floats(-3.0, 3.0), min_size=12, max_size=12), gain=st.floats(0.0, 20.0),
)  # fmt: skip
@hypothesis_settings(max_examples=60)
def test_limits_are_kept_whatever_the_target_and_the_readings(
    quick_plan, estimated, name, base, stretch, step, reach, advance, readings, gain
):
    """The simulator raises CommandError for a step or place out of range; the plan is one of a larger setup."""
    scenario = PHANTOM.with_values(
        {
            "setup.max_guide_step_mm": step, "setup.max_guide_travel_mm": reach, "target.lateral_mm": 0.0,
            "setup.max_advance_mm": advance, "control.resolved_rate.gain": gain,
            "setup.max_base_step_mm": step, "setup.max_base_travel_mm": reach,
            "control.ce_mpc.samples": 8, "control.ce_mpc.iterations": 1,
        }
    )  # fmt: skip
    wide = replace(
        quick_plan, tips=stretched(quick_plan.tips, stretch, Y, THETA), target=(40.0, 5.0 * stretch, 0.0),
        controls=stretched(quick_plan.controls, stretch, DG_Y) + STILL._replace(db_y=base, db_theta=0.1 * base),
        guide=quick_plan.guide * stretch,
    )  # fmt: skip
    commands, state = drive(name, wide, scenario, estimated, readings, steps=12)
    assert np.isfinite(commands).all()
    assert np.abs(commands[:, DG_Y]).max() <= step + 1e-12
    assert np.abs(np.cumsum(commands[:, DG_Y])).max() <= reach + 1e-9
    assert np.abs(commands[:, DB_Y]).max() <= step + 1e-12
    assert np.abs(commands[:, DB_THETA]).max() <= 5e-3 + 1e-12
    assert np.abs(np.cumsum(commands[:, DB_Y])).max() <= reach + 1e-9
    assert (commands[:, DB_X] > 0.0).all()
    assert commands[:, DB_X].max() <= advance + 1e-12
    assert state.converged


@pytest.mark.parametrize("name", ["resolved-rate", "broyden-mpc"])
def test_towards_a_path_beyond_its_reach_the_guide_moves_to_its_limit_and_no_further(
    quick_plan, estimated, name
):
    scenario = PHANTOM.with_values({"setup.max_guide_travel_mm": 0.8, "target.lateral_mm": 0.0})
    offset = np.array([0.0, 6.0, 0.0, 0.0, 0.0])
    away = replace(quick_plan, tips=quick_plan.tips + offset, target=(40.0, 11.0, 0.0))
    commands, _ = drive(name, away, scenario, estimated, [0.0] * 8, steps=8)
    assert np.cumsum(commands[:, DG_Y]).max() == pytest.approx(0.8, abs=1e-9)
    assert np.abs(commands[:, DG_Y]).max() == pytest.approx(0.5)


@pytest.mark.parametrize("name", ["open-loop", "ce-mpc", "resolved-rate", "broyden-mpc"])
def test_planned_motion_of_the_base_is_followed(quick_plan, estimated, name):
    """The base moves to its planned place at the tip's depth; the other controllers leave it alone."""
    moving = quick_plan.controls.copy()
    moving[:60, [DB_Y, DB_THETA]] = 0.02, 1e-4
    plan = replace(quick_plan, controls=moving)
    commands, state = drive(name, plan, PHANTOM, estimated, [0.0] * 30, steps=30)
    depth = [-28.5, *(-28.5 + np.cumsum(commands[:, DB_X]))]
    planned = np.interp(depth[-1], plan.tips[:, X], np.arange(len(plan.tips)))
    np.testing.assert_allclose(state.travel[[DB_Y, DB_THETA]], planned * np.array([0.02, 1e-4]), rtol=0.03)


@cache
def noise():
    return tuple(np.random.default_rng(5).normal(0.0, 0.05, 80).tolist())


@pytest.mark.parametrize("name", FIELD)
def test_mirrored_plan_and_readings_give_mirrored_commands(short_plan, mirrored, estimated, name):
    """The tissue has another stiffness; the controllers that flip do."""
    plant = short_plan.scenario.with_values({f"tissue.{k}.shear_modulus_kpa": 5.0 for k in (0, 1)})
    scenario = short_plan.scenario.with_values({"control.resolved_rate.curvature_per_m": 3.0})
    here, end = drive(name, short_plan, scenario, estimated, noise(), steps=30, plant=plant)
    away = tuple(-off for off in noise())
    there, other_end = drive(name, mirrored(short_plan), scenario, estimated, away, steps=30, plant=plant)
    np.testing.assert_allclose(there, stretched(here, -1.0, DB_Y, DB_THETA, DG_Y), atol=1e-9)
    np.testing.assert_allclose(other_end.tip, end.tip * MIRROR, atol=1e-9)
    assert np.abs(here[:, DG_Y]).max() > 0.0 or name == "bevel-only"


def test_with_exact_readings_the_guide_takes_the_tip_to_the_target(quick_plan, estimated):
    """The tissue is three times as stiff as planned, so that the plan alone misses."""
    plant = PHANTOM.with_values({f"tissue.{k}.shear_modulus_kpa": 6.0 for k in (0, 1)})
    blind, *steered = (
        abs(drive(name, quick_plan, PHANTOM, estimated, [0.0] * 80, steps=80, plant=plant)[1].tip[Y] - 5.0)
        for name in ("open-loop", "resolved-rate", "broyden-mpc")
    )
    assert blind > 0.2
    assert max(steered) < 0.25 * blind


# ---- on the exact plant, with its delay, noise, missing readings, play and friction


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("name", CONTROLLERS)
def test_every_controller_finishes_on_every_plant_with_its_commands_carried_out(short_plan, name, plant):
    """A motor leaves less than its resolution out of a step; nothing else is cut from a command."""
    coarse = {"phantom.element_mm": 1.0, "phantom.step_mm": 0.5, "phantom.start_axial_sd_mm": 0.0}
    scenario = short_plan.scenario.with_values(coarse)
    done = flexneedle.insert(
        scenario, short_plan, 5001, controller=name, rig=flexneedle.VirtualRig(plant), force=True, threads=1
    )
    assert (done.outcome, done.controller, done.phantom) == ("done", name, plant)
    left_out = np.subtract(
        [period.command for period in done.periods], [period.applied for period in done.periods]
    )
    assert np.abs(left_out[:, :ROLL]).max() <= PHANTOM.phantom.motor_resolution_mm + 1e-9
    np.testing.assert_allclose(np.cos(left_out[:, ROLL:]), 1.0)  # half a turn either way
    assert all(period.converged and period.decision for period in done.periods)
    assert done.true_error_mm < (3.0 if name in WITHOUT_GUIDE else 0.6)
    assert done.periods[-1].true_tip.x == pytest.approx(20.0, abs=0.15 if name != "open-loop" else 0.5)
    assert len(done.periods) <= 1.1 * len(short_plan.controls) + 4
    assert_predicted_shapes(done, short_plan.target)
    if name in ("open-loop", "broyden-mpc"):
        assert done.flips == 0
    if name == "bevel-only":
        assert not any(any(period.command[DB_Y:ROLL]) for period in done.periods)


def test_without_a_guide_they_work_or_report_that_they_need_one(short_plan):
    bare = short_plan.scenario.with_values({"setup.guide_to_skin_mm": None, "plan.iterations": 2})
    plan = flexneedle.plan(bare, (20.0, 0.0), seed=0, threads=1)
    for name in FIELD:
        options = {"controller": name, "rig": flexneedle.VirtualRig("model"), "force": True, "threads": 1}
        if name in WITHOUT_GUIDE:
            assert flexneedle.insert(bare, plan, 5000, **options).outcome == "done"
            continue
        with pytest.raises(InputError, match=f"'{name}'.*setup.guide_to_skin_mm"):
            flexneedle.insert(bare, plan, 5000, **options)
