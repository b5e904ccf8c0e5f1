"""The closed loop without faults: its record, its random streams, and its access to the phantom."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import flexneedle
from flexneedle.control.controllers import DEFAULT
from flexneedle.loop import insertions
from flexneedle.loop.events import PeriodEnded
from flexneedle.loop.rig import Rig
from flexneedle.loop.virtual import VirtualRig
from flexneedle.phantom.plants import PLANTS
from flexneedle.results import Insertion, Outcome
from insertions import (
    PHANTOM,
    STILL,
    RecordedPhantom,
    TapedRig,
    commanded_and_estimated,
    facts,
    first_periods,
    moving,
    on_period,
    run,
)


def test_record_is_complete_for_every_period(plan, real):
    done, recorded = real
    assert (done.outcome, done.reason) == ("done", "")
    assert done.plan is plan
    assert [period.index for period in done.periods] == list(range(len(done.periods)))
    times = [period.time for period in done.periods]
    assert all(np.diff(times) > 0.0)
    assert times[-1] == pytest.approx(recorded.phantom.now())
    assert [period.command for period in moving(done)] == [command for _, command in recorded.moves]
    assert [period.applied for period in moving(done)] == recorded.applied
    for period, batch in zip(done.periods, recorded.tape, strict=True):
        assert period.measurement == batch[-1]
        assert str(period.verdict) == "ok"
        # Except for the motors' resolution, and half turns to either side.
        applied = period.applied._replace(roll=abs(period.applied.roll))
        np.testing.assert_allclose(applied, period.command, atol=0.01)
        assert period.shape.shape == (61, 5)
        assert period.stretch == 1.0 if period.estimate.x < 0.0 else 0.5 < period.stretch <= 1.0
        assert period.decision
        assert math.isfinite(period.cost)
        assert period.spread > 0.0
        on_plan = np.clip(period.estimate.x, plan.tips[0, 0], plan.tips[-1, 0])
        assert period.path.x == pytest.approx(on_plan, abs=0.02)
        assert period.true_stretch <= 1.0
        assert period.true_strain_energy >= 0.0
        assert 1e3 * period.energy_scale == done.invasiveness.energy_scale_uj > 0.0
        assert np.isfinite([*period.estimate, *period.base, *period.true_tip, *period.tip_load]).all()
        assert period.durations.keys() == {"decide", "apply", "observe", "total"}
        parts = period.durations["decide"] + period.durations["observe"]
        assert period.durations["total"] == pytest.approx(parts)
        assert period.converged
    assert min(period.stretch for period in done.periods) < 1.0


def test_the_record_ends_with_the_true_state(plan, real):
    done, recorded = real
    condition = recorded.phantom.condition()
    assert done.true_error_mm == pytest.approx(math.dist(condition.tip[:3], plan.target))
    last = recorded.tape[-1][-1]
    assert done.residual_mm == pytest.approx(math.dist((last.x, last.y), plan.target[:2]))
    assert done.flips == sum(command.rolls for _, command in recorded.moves)
    assert done.periods[-1].true_strain_energy == condition.strain_energy
    assert done.periods[-1].true_stretch == condition.least_stretch < 1.0
    assert all(np.diff([period.true_stretch for period in done.periods]) <= 0.0)
    assert done.reached
    assert done.periods[-1].estimate.x >= plan.target[0] - PHANTOM.control.depth_tolerance_mm
    assert done.periods[-2].estimate.x < plan.target[0] - PHANTOM.control.depth_tolerance_mm


def test_products_of_matrices_have_one_thread_during_an_insertion(plan):
    """Its results would depend on their number; the caller's number is restored."""
    counts = []

    def count_threads(event):
        if isinstance(event, PeriodEnded):
            counts.append(number_of_threads())

    def number_of_threads():
        return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}

    with threadpool_limits(2, user_api="blas"):
        flexneedle.insert(PHANTOM, plan, controller="open-loop", listeners=[count_threads])
        assert number_of_threads() == {2}
    assert counts == [{1}] * len(counts)
    assert len(counts) > 20


@pytest.mark.long
def test_phantoms_of_other_seeds_are_reached(plan, inserted):
    """With all default imperfections; extra periods are rests for the last reading or holds for missing readings."""
    done = [inserted(seed) for seed in range(2001, 2005)]
    assert all(one.reached for one in done)
    assert np.mean([one.true_error_mm for one in done]) < 0.4
    assert all(len(moving(one)) <= 1.1 * len(plan.controls) for one in done)
    assert all(period.converged for one in done for period in one.periods)


def test_the_record_depends_on_the_seed_and_not_on_the_threads(inserted):
    """To the last bit."""
    one, again = (inserted(2001, **options) for options in ({}, {"threads": 1}))
    assert list(map(facts, one.periods)) == list(map(facts, again.periods))
    assert (one.seed, one.phantom, one.controller) == (2001, "exact", DEFAULT)
    assert (one.outcome, one.reason) == (again.outcome, again.reason) == ("done", "")


def test_both_plants_have_the_same_start(inserted):
    """Same draw, same noise; some imperfections exist only in the exact plant."""
    exact, model = inserted(2001), inserted(2001, "model", "resolved-rate")
    assert exact.periods[0].true_tip.y == pytest.approx(model.periods[0].true_tip.y, abs=0.5)
    assert exact.periods[-1].true_tip != model.periods[-1].true_tip
    assert model.true_error_mm < 1.0


def test_phantom_tracker_and_search_have_independent_random_streams(plan, monkeypatch):
    drawn, plants = [], []

    def virtual_rig(_scenario, _roll, seeds, phantom, **_options):
        drawn.extend(np.random.default_rng(seed).random() for seed in dataclasses.astuple(seeds))
        plants.append(phantom)

    def no_run(steering, _rig):
        drawn.append(steering.rng.random())
        return Insertion(plan, 0, (), Outcome("done"), "")

    monkeypatch.setattr("flexneedle.loop.virtual.virtual_rig", virtual_rig)
    monkeypatch.setattr(insertions, "run", no_run)
    for seed, phantom in ((0, "exact"), (1, "exact"), (0, "model")):
        insertions.insert(PHANTOM, plan, seed, rig=VirtualRig(phantom))
    assert len(set(drawn)) == 8
    assert drawn[:4] == drawn[8:]
    assert plants == [PLANTS["exact"], PLANTS["exact"], PLANTS["model"]]


def test_each_period_is_sent_when_it_ends(plan):
    periods = []
    recorded = RecordedPhantom(plan.roll)
    part = replace(plan, target=(-20.0, 0.0, 0.0))

    def watch(period):
        periods.append(period)
        moved = [one for one in periods if one.command != STILL]
        assert len(recorded.moves) == len(moved)  # before the next one moves

    done = run(part, recorded.rig(), listeners=[on_period(watch)], force=True)
    assert done.periods == tuple(periods)
    assert len(periods) > 5


# ---- no other access to the phantom


def test_replayed_readings_give_the_same_commands(plan, real):
    """With another phantom: the controller has access only to readings and applied commands."""
    done, recorded = real
    other, stage = RecordedPhantom(plan.roll, seed=2777), TapedRig(recorded.tape)
    rig = Rig(other.phantom, other, stage, other.phantom.condition)
    swapped = run(plan, rig, controller=DEFAULT)
    assert swapped.outcome == "done"
    assert list(map(commanded_and_estimated, swapped.periods)) == list(
        map(commanded_and_estimated, done.periods)
    )
    assert swapped.periods[-1].true_tip != done.periods[-1].true_tip


def test_other_readings_give_other_commands(plan, real):
    """The replay is sensitive: an error of 1.5 mm in one reading changes the commands that follow."""
    done, recorded = real
    at = 30  # before the first roll, whose time the taped rig does not count
    changed = [replace(recorded.tape[at][-1], y=recorded.tape[at][-1].y + 1.5)]
    tape = [*recorded.tape[:at], (*recorded.tape[at][:-1], *changed), *recorded.tape[at + 1 :]]
    rig = TapedRig(tape, recorded.applied).rig()
    other = first_periods(at + 2, plan, rig, controller=DEFAULT)
    same = [one.command == two.command for one, two in zip(done.periods, other, strict=False)]
    assert same == [True] * (at + 1) + [False]
