"""The closed loop where nothing fails: its record, its randomness, and no other access to the phantom."""

import dataclasses
import math
import pkgutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import flexneedle
import flexneedle.control
from flexneedle.errors import InputError
from flexneedle.rig import loop as insertion
from flexneedle.rig.phantom.plants import PLANTS
from flexneedle.rig.virtual import Rig
from flexneedle.types import Insertion, Outcome
from insertions import (
    PHANTOM,
    READING,
    STILL,
    Stage,
    Tank,
    believed,
    facts,
    loop,
    moving,
    run,
)


def test_record_is_complete_for_every_period(plan, real):
    done, tank = real
    assert (done.outcome, done.reason) == ("done", "")
    assert done.plan is plan
    assert [period.index for period in done.periods] == list(range(len(done.periods)))
    times = [period.time for period in done.periods]
    assert all(np.diff(times) > 0.0)
    assert times[-1] == pytest.approx(tank.phantom.now())
    assert [period.command for period in moving(done)] == [command for _, command in tank.moves]
    assert [period.applied for period in moving(done)] == tank.applied
    for period, batch in zip(done.periods, tank.tape, strict=True):
        assert period.sample == batch[-1]
        assert str(period.verdict) == "ok"
        np.testing.assert_allclose(
            period.applied, period.command, atol=0.01
        )  # but for the motors' resolution
        assert period.shape.shape == (61, 3)
        assert period.decision
        assert math.isfinite(period.cost)
        assert period.spread > 0.0
        on_plan = np.clip(period.estimate[0], plan.tips[0, 0], plan.tips[-1, 0])
        assert period.path[0] == pytest.approx(on_plan, abs=0.02)
        assert period.true_stretch <= 1.0
        assert period.true_strain_energy >= 0.0
        assert np.isfinite([*period.estimate, *period.base, *period.true_tip, period.tip_load]).all()
        assert period.durations.keys() == {"decide", "apply", "observe", "total"}
        parts = period.durations["decide"] + period.durations["observe"]
        assert period.durations["total"] == pytest.approx(parts)
        assert period.converged


def test_record_has_the_truth_at_its_end(plan, real):
    done, tank = real
    condition = tank.phantom.condition()
    x, y = condition.tip[:2]
    assert done.true_error_mm == pytest.approx(math.hypot(x - 40.0, y - 5.0))
    last = tank.tape[-1][-1]
    assert done.residual_mm == pytest.approx(math.hypot(last.x - 40.0, last.y - 5.0))
    assert done.flips == sum(command[4] > 0 for _, command in tank.moves)
    assert done.periods[-1].true_strain_energy == condition.strain_energy
    assert done.periods[-1].true_stretch == condition.least_stretch < 1.0
    assert all(np.diff([period.true_stretch for period in done.periods]) <= 0.0)
    assert done.reached
    assert done.periods[-1].estimate[0] >= plan.target[0] - PHANTOM.control.depth_tolerance_mm
    assert done.periods[-2].estimate[0] < plan.target[0] - PHANTOM.control.depth_tolerance_mm


def test_speed_is_that_of_the_scenario_rounded_up_to_whole_readings(real):
    done, _ = real
    times = [0.0, *(period.time for period in done.periods)]
    for period, duration in zip(done.periods, np.diff(times), strict=True):
        if period.command == STILL:  # a rest, for late readings
            continue
        needed = period.command[0] / PHANTOM.setup.insertion_speed_mm_s
        assert needed - 1e-6 <= duration < needed + READING
        assert duration / READING == pytest.approx(round(duration / READING))


@pytest.mark.long
def test_phantoms_of_other_seeds_are_reached(plan, inserted):
    """With all that a rig has, as shipped; a period more is the rest for the last reading, or one that was missing."""
    done = [inserted(seed) for seed in range(2001, 2005)]
    assert all(one.reached for one in done)
    assert np.mean([one.true_error_mm for one in done]) < 0.4
    assert all(len(moving(one)) <= 1.1 * len(plan.controls) for one in done)
    assert all(period.converged for one in done for period in one.periods)


@pytest.mark.parametrize("phantom", ["exact", "model"])
def test_same_seed_same_record_whatever_the_threads(inserted, phantom):
    """To the last bit, in both plants."""
    one, again = (inserted(2001, phantom, threads=threads) for threads in (None, 1))
    assert list(map(facts, one.periods)) == list(map(facts, again.periods))
    assert (one.seed, one.phantom, one.controller) == (2001, phantom, "adaptive-mpc")
    assert (one.outcome, one.reason) == (again.outcome, again.reason) == ("done", "")


def test_another_seed_is_another_phantom_tracker_and_search(inserted):
    one, other = inserted(2001), inserted(2002)
    assert one.true_error_mm != other.true_error_mm
    assert one.periods[0].true_tip != other.periods[0].true_tip
    assert one.periods[0].sample != other.periods[0].sample
    assert one.periods[0].spread != other.periods[0].spread


def test_the_other_plant_has_the_same_start_and_another_needle(inserted):
    """Same draw, same noise; what only the exact one has is missing in the other."""
    exact, model = inserted(2001), inserted(2001, "model")
    assert exact.periods[0].true_tip[1] == pytest.approx(model.periods[0].true_tip[1], abs=0.5)
    assert exact.periods[-1].true_tip != model.periods[-1].true_tip
    assert model.true_error_mm < 1.0


def test_unknown_names_of_plant_and_controller_are_refused_with_the_choices(plan):
    with pytest.raises(InputError, match="phantom = 'gel': must be one of exact, model"):
        flexneedle.insert(PHANTOM, plan, 0, phantom="gel")
    with pytest.raises(InputError, match="controller = 'pid': must be one of adaptive-mpc, "):
        flexneedle.insert(PHANTOM, plan, 0, controller="pid")


def test_phantom_tracker_and_search_have_random_streams_of_their_own(plan, monkeypatch):
    drawn, plants = [], []

    def virtual_rig(_scenario, _bevel, seeds, phantom, **_options):
        drawn.extend(np.random.default_rng(seed).random() for seed in dataclasses.astuple(seeds))
        plants.append(phantom)

    def no_run(_scenario, plan, _rig, rng, *_args, **_options):
        drawn.append(rng.random())
        return Insertion(plan, 0, (), Outcome("done"), "")

    monkeypatch.setattr(insertion, "virtual_rig", virtual_rig)
    monkeypatch.setattr(insertion, "run", no_run)
    for seed, phantom in ((0, "exact"), (1, "exact"), (0, "model")):
        insertion.insert(PHANTOM, plan, seed, phantom=phantom)
    assert len(set(drawn)) == 8
    assert drawn[:4] == drawn[8:]
    assert plants == [PLANTS["exact"], PLANTS["exact"], PLANTS["model"]]


def test_on_period_gets_each_period_as_it_ends(plan):
    seen = []
    tank = Tank(plan.bevel)
    part = replace(plan, target=(-20.0, 0.0))

    def watch(period):
        seen.append(period)
        moved = [one for one in seen if one.command != STILL]
        assert len(tank.moves) == len(moved)  # before the next one moves

    done = run(part, tank.rig(), on_period=watch, force=True)
    assert done.periods == tuple(seen)
    assert len(seen) > 5


# ---- no other access to the phantom


def test_replayed_readings_without_any_phantom_give_the_same_commands(real, replayed):
    """All that the controller learns are the readings and what was applied: they alone make the same record."""
    assert list(map(believed, replayed.periods)) == list(map(believed, real[0].periods))
    assert replayed.outcome == "done"


def test_late_readings_replayed_give_the_same_commands(plan, late):
    done, tank = late
    replayed = run(plan, Stage(tank.tape, tank.applied).rig())
    assert list(map(believed, replayed.periods)) == list(map(believed, done.periods))
    assert replayed.outcome == "done"


def test_replayed_readings_before_another_phantom_give_the_same_commands(plan, real):
    done, tank = real
    other, stage = Tank(plan.bevel, seed=2777), Stage(tank.tape)
    swapped = run(plan, Rig(other.phantom, other, stage, other.phantom.condition))
    assert list(map(believed, swapped.periods)) == list(map(believed, done.periods))
    assert swapped.periods[-1].true_tip != done.periods[-1].true_tip


def test_other_readings_give_other_commands(plan, real):
    """The replay would notice a change: one reading off by 1.5 mm alters the commands that follow."""
    done, tank = real
    at = 40
    changed = [replace(tank.tape[at][-1], y=tank.tape[at][-1].y + 1.5)]
    tape = [*tank.tape[:at], (*tank.tape[at][:-1], *changed), *tank.tape[at + 1 :]]
    other = run(plan, Stage(loop(tape), tank.applied[: at + 1]).rig())
    commands = [[period.command for period in one.periods] for one in (done, other)]
    assert commands[0][: at + 1] == commands[1][: at + 1]
    assert commands[0][at + 1] != commands[1][at + 1]


def test_control_does_not_load_the_phantom():
    package = flexneedle.control
    modules = [found.name for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")]
    assert {"flexneedle.control.mpc", "flexneedle.control.methods.adaptive_mpc"} <= set(modules)
    code = "; ".join([f"import {name}" for name in modules])
    code += "; import sys; sys.exit('flexneedle.rig' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_layers_forbid_control_to_import_the_phantom():
    text = (Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8")
    contracts = tomllib.loads(text)["tool"]["importlinter"]["contracts"]
    (layers,) = [contract["layers"] for contract in contracts if contract["type"] == "layers"]
    assert layers.index("(rig)") < layers.index("(control)")
