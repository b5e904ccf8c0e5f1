"""What every controller of the field keeps to: limits, mirror symmetry, determinism, and an end at the target depth."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

import flexneedle
from flexneedle.control.controllers import CONTROLLERS, DEFAULT, find_controller
from flexneedle.control.interface import travel_left
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


def test_they_are_there_under_their_names():
    assert set(FIELD) <= set(CONTROLLERS)
    assert DEFAULT not in FIELD
    for name in FIELD:
        assert find_controller(name)[1].name == name
        assert find_controller(name)[1].summary
    with pytest.raises(InputError, match=r"controller = 'pid': must be one of .*broyden-mpc"):
        find_controller("pid")


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
def test_towards_a_path_beyond_its_reach_the_guide_moves_to_the_end_of_that_and_no_further(
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
    """To where the plan has it at the tip's depth; the other methods steer with guide or bevel alone."""
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
def test_mirrored_plan_and_readings_give_mirrored_commands(quick_plan, mirrored, estimated, name):
    """Through a whole insertion into tissue of another stiffness, with flips where the method makes them."""
    plant = PHANTOM.with_values({f"tissue.{k}.shear_modulus_kpa": 5.0 for k in (0, 1)})
    scenario = PHANTOM.with_values({"control.resolved_rate.curvature_per_m": 3.0})
    here, end = drive(name, quick_plan, scenario, estimated, noise(), steps=80, plant=plant)
    away = tuple(-off for off in noise())
    there, other_end = drive(name, mirrored(quick_plan), scenario, estimated, away, steps=80, plant=plant)
    np.testing.assert_allclose(there, stretched(here, -1.0, DB_Y, DB_THETA, DG_Y), atol=1e-9)
    np.testing.assert_allclose(other_end.tip, end.tip * MIRROR, atol=1e-9)
    assert np.abs(here[:, DG_Y]).max() > 0.0 or name == "bevel-only"


@pytest.mark.parametrize("name", ["bevel-only", "resolved-rate", "broyden-mpc"])
def test_the_end_is_at_the_target_depth(quick_plan, estimated, name):
    _, state = drive(name, quick_plan, PHANTOM, estimated, noise(), steps=80)
    assert 0.0 <= travel_left(PHANTOM, quick_plan, state) <= PHANTOM.control.depth_tolerance_mm


@pytest.mark.parametrize("name", ["resolved-rate", "broyden-mpc"])
def test_with_exact_readings_the_guide_takes_the_tip_to_the_target(quick_plan, estimated, name):
    """In tissue thrice as stiff as planned for, where the plan alone misses."""
    plant = PHANTOM.with_values({f"tissue.{k}.shear_modulus_kpa": 6.0 for k in (0, 1)})
    _, blind = drive("open-loop", quick_plan, PHANTOM, estimated, [0.0] * 80, steps=80, plant=plant)
    _, steered = drive(name, quick_plan, PHANTOM, estimated, [0.0] * 80, steps=80, plant=plant)
    assert abs(blind.tip[Y] - 5.0) > 0.2
    assert abs(steered.tip[Y] - 5.0) < 0.25 * abs(blind.tip[Y] - 5.0)


# ---- on the exact plant, with its delay, noise, missing readings, play and friction


@cache
def inserted(name, plan, seed=5000, **changes):
    scenario = PHANTOM.with_values(dict(changes))
    return flexneedle.insert(scenario, plan, seed, controller=name, force=True, threads=1)


@pytest.mark.parametrize(
    ("name", "limit"), [("open-loop", 3.0), ("bevel-only", 7.0), ("resolved-rate", 0.4), ("broyden-mpc", 0.5)]
)
def test_a_whole_insertion_into_the_exact_plant_ends_done(quick_plan, name, limit):
    done = inserted(name, quick_plan)
    assert (done.outcome, done.controller) == ("done", name)
    assert done.true_error_mm < limit
    assert done.periods[-1].true_tip.x == pytest.approx(40.0, abs=0.15 if name != "open-loop" else 0.5)
    assert all(period.converged and period.decision for period in done.periods)
    assert len(done.periods) <= 1.1 * len(quick_plan.controls) + 2
    if name in ("open-loop", "broyden-mpc"):
        assert done.flips == 0
    if name == "bevel-only":
        assert not any(any(period.command[DB_Y:ROLL]) for period in done.periods)


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("name", CONTROLLERS)
def test_every_controller_finishes_on_every_plant_with_its_commands_carried_out(quick_plan, name, plant):
    """What a motor leaves out of a step is less than its resolution; nothing else is cut from a command."""
    few = {"control.ce_mpc.samples": 8, "control.ce_mpc.iterations": 1}
    few |= {f"control.adaptive_mpc.{key}": value for key, value in (("samples", 12), ("iterations", 1))}
    scenario = PHANTOM.with_values(few)
    done = flexneedle.insert(
        scenario, quick_plan, 5001, controller=name, rig=flexneedle.VirtualRig(plant), threads=1
    )
    assert (done.outcome, done.controller, done.phantom) == ("done", name, plant)
    left_out = np.subtract(
        [period.command for period in done.periods], [period.applied for period in done.periods]
    )
    assert np.abs(left_out[:, :ROLL]).max() <= PHANTOM.phantom.motor_resolution_mm + 1e-9
    assert (left_out[:, ROLL:] == 0.0).all()
    assert all(period.converged for period in done.periods)
    assert np.isfinite(done.true_error_mm)


@pytest.mark.parametrize("name", FIELD)
def test_without_a_guide_they_work_or_say_what_they_need(name):
    bare = PHANTOM.with_values({"setup.guide_to_skin_mm": None, "plan.iterations": 2})
    plan = flexneedle.plan(bare, (25.0, 0.0), seed=0, threads=1)
    if name in WITHOUT_GUIDE:
        done = flexneedle.insert(bare, plan, 5000, controller=name, force=True, threads=1)
        assert done.outcome == "done"
        return
    with pytest.raises(InputError, match=f"controller = '{name}': needs a guide that moves"):
        flexneedle.insert(bare, plan, 5000, controller=name, force=True, threads=1)
