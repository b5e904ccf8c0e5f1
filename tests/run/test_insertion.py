"""The closed loop against trackers and drivers that fail, and against no phantom at all."""

import dataclasses
import math
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import flexneedle
from flexneedle.errors import RunError
from flexneedle.phantom import Phantom, draw
from flexneedle.ports import Sample
from flexneedle.run import insertion
from flexneedle.run.insertion import Rig
from flexneedle.simulator import State
from flexneedle.tracking import NoisyTracker

PHANTOM = flexneedle.load_scenario("phantom")
STILL = (0.0, 0.0, 0.0, 0.0, -1)
READING = PHANTOM.tracker.period


class Tank:
    """A phantom whose driver calls are counted, behind a tracker whose batches are changed and taped."""

    def __init__(self, bevel, seed=2000, spoil=lambda batch: batch, scenario=PHANTOM):
        self.phantom = Phantom(draw(scenario, np.random.default_rng(seed)), bevel)
        self.spoil, self.tape, self.moves = spoil, [], []
        noise = np.random.default_rng(seed + 1)
        jitter = scenario.tracker.jitter_per_axis
        self.eye = NoisyTracker(self.phantom.tip_at, self.phantom, scenario.tracker.period, jitter, noise)

    def read(self):
        self.tape.append(self.spoil(self.eye.read()))
        return self.tape[-1]

    def apply(self, command, duration):
        self.moves.append((self.phantom.now(), command))
        return self.phantom.apply(command, duration)

    def rig(self):
        return Rig(self.phantom, self, self, lambda: self.phantom.state)


class Stage:
    """No phantom: a clock that adds up, a driver that does nothing, a tracker that plays a tape."""

    def __init__(self, tape):
        self.time, self.tape = 0.0, iter(tape)

    def now(self):
        return self.time

    def wait(self, seconds):
        self.time += seconds

    def apply(self, command, duration):
        self.time += duration
        return command

    def read(self):
        return next(self.tape)

    def rig(self):
        return Rig(self, self, self)


@pytest.fixture(scope="module")
def plan():
    return flexneedle.plan(PHANTOM, (40.0, 5.0), seed=1)


@pytest.fixture(scope="module")
def real(plan):
    """An insertion against a phantom, and what its tracker said."""
    tank = Tank(plan.bevel)
    return run(plan, tank.rig()), tank


def run(plan, rig, scenario=PHANTOM, seed=5, **options):
    return insertion.run(scenario, plan, rig, np.random.default_rng(seed), **options)


def facts(period):
    """All of a period but its wall-clock durations, as values that compare."""
    names = [field.name for field in dataclasses.fields(period) if field.name != "durations"]
    values = {name: getattr(period, name) for name in names}
    return {k: repr(v) if not isinstance(v, np.ndarray) else v.tobytes() for k, v in values.items()}


def believed(period):
    """What the controller did and believed, without the truth."""
    return {name: value for name, value in facts(period).items() if not name.startswith("true_")}


# ---- a good run


def test_record_is_complete_for_every_period(plan, real):
    done, tank = real
    assert (done.outcome, done.reason) == ("done", "")
    assert done.plan is plan
    assert [period.index for period in done.periods] == list(range(len(done.periods)))
    times = [period.time for period in done.periods]
    assert all(np.diff(times) > 0.0)
    assert times[-1] == pytest.approx(tank.phantom.now())
    assert [period.command for period in done.periods] == [command for _, command in tank.moves]
    for period, batch in zip(done.periods, tank.tape, strict=True):
        assert period.sample == batch[-1]
        assert period.verdict == "ok"
        assert period.applied == period.command
        assert period.shape.shape == (61, 3)
        assert period.decision
        assert math.isfinite(period.cost)
        assert period.spread > 0.0
        assert period.path[0] == pytest.approx(min(period.estimate[0], plan.tips[-1, 0]), abs=0.02)
        assert np.isfinite([*period.estimate, *period.base, *period.true_tip, period.tip_load]).all()
        assert period.durations.keys() == {"decide", "apply", "observe", "total"}
        parts = period.durations["decide"] + period.durations["observe"]
        assert period.durations["total"] == pytest.approx(parts)
        assert period.converged


def test_record_has_the_truth_at_its_end(plan, real):
    done, tank = real
    x, y = tank.phantom.state.tip[:2]
    assert done.true_error_mm == pytest.approx(math.hypot(x - 40.0, y - 5.0))
    last = tank.tape[-1][-1]
    assert done.residual_mm == pytest.approx(math.hypot(last.x - 40.0, last.y - 5.0))
    assert done.flips == sum(command[4] > 0 for _, command in tank.moves)
    assert done.periods[-1].true_strain_energy == tank.phantom.state.strain_energy
    assert done.reached
    assert done.periods[-1].estimate[0] >= plan.target[0] - PHANTOM.control.depth_tolerance_mm
    assert done.periods[-2].estimate[0] < plan.target[0] - PHANTOM.control.depth_tolerance_mm


def test_speed_is_that_of_the_scenario_rounded_up_to_whole_readings(real):
    done, _ = real
    times = [0.0, *(period.time for period in done.periods)]
    for period, duration in zip(done.periods, np.diff(times), strict=True):
        needed = period.command[0] / PHANTOM.setup.insertion_speed_mm_s
        assert needed - 1e-6 <= duration < needed + READING
        assert duration / READING == pytest.approx(round(duration / READING))


def test_phantoms_of_other_seeds_are_reached(plan):
    done = [flexneedle.insert(PHANTOM, plan, seed=seed) for seed in range(2001, 2005)]
    assert all(one.reached for one in done)
    assert np.mean([one.true_error_mm for one in done]) < 0.4
    assert all(len(one.periods) <= 1.1 * len(plan.controls) for one in done)


def test_same_seed_same_record_other_seed_another(plan):
    one, again, other = (flexneedle.insert(PHANTOM, plan, seed=seed) for seed in (2001, 2001, 2002))
    assert list(map(facts, one.periods)) == list(map(facts, again.periods))
    assert one.seed == 2001
    assert one.true_error_mm != other.true_error_mm
    # Phantom, tracker and search each have a stream of their own.
    assert one.periods[0].true_tip != other.periods[0].true_tip
    assert one.periods[0].sample != other.periods[0].sample
    assert one.periods[0].spread != other.periods[0].spread


def test_phantom_tracker_and_search_have_random_streams_of_their_own(plan, monkeypatch):
    drawn = []

    def virtual_rig(_scenario, _bevel, *seeds):
        drawn.extend(np.random.default_rng(seed).random() for seed in seeds)

    def no_run(_scenario, _plan, _rig, rng, *_args, **_options):
        drawn.append(rng.random())

    monkeypatch.setattr(insertion, "virtual_rig", virtual_rig)
    monkeypatch.setattr(insertion, "run", no_run)
    for seed in (0, 1, 0):
        insertion.insert(PHANTOM, plan, seed)
    assert len(set(drawn)) == 6
    assert drawn[:3] == drawn[6:]


def test_on_period_gets_each_period_as_it_ends(plan):
    seen = []
    tank = Tank(plan.bevel)
    part = replace(plan, target=(-20.0, 0.0))

    def watch(period):
        assert len(tank.moves) == len(seen) + 1  # before the next one moves
        seen.append(period)

    done = run(part, tank.rig(), on_period=watch, force=True)
    assert done.periods == tuple(seen)
    assert len(seen) > 5


# ---- no other access to the phantom


def test_replayed_readings_without_any_phantom_give_the_same_commands(plan, real):
    """All that the controller learns of the phantom are the readings: they alone make the same record."""
    done, tank = real
    replayed = run(plan, Stage(tank.tape).rig())
    assert list(map(believed, replayed.periods)) == list(map(believed, done.periods))
    assert replayed.outcome == "done"


def test_replayed_readings_before_another_phantom_give_the_same_commands(plan, real):
    done, tank = real
    other, stage = Tank(plan.bevel, seed=2777), Stage(tank.tape)
    swapped = run(plan, Rig(other.phantom, other, stage, lambda: other.phantom.state))
    assert list(map(believed, swapped.periods)) == list(map(believed, done.periods))
    assert swapped.periods[-1].true_tip != done.periods[-1].true_tip


def test_other_readings_give_other_commands(plan, real):
    """The replay would notice a change: one reading off by 0.3 mm alters the commands that follow."""
    done, tank = real
    at = 40
    changed = [replace(tank.tape[at][-1], y=tank.tape[at][-1].y + 0.3)]
    tape = [*tank.tape[:at], (*tank.tape[at][:-1], *changed), *tank.tape[at + 1 :]]
    other = run(plan, Stage([*tape, *tape[-1:] * 9]).rig())
    commands = [[period.command for period in one.periods] for one in (done, other)]
    assert commands[0][: at + 1] == commands[1][: at + 1]
    assert commands[0][at + 1] != commands[1][at + 1]


def test_control_does_not_load_the_phantom():
    modules = ["bang_bang", "controller", "mpc", "observer"]
    code = "; ".join([f"import flexneedle.control.{name}" for name in modules])
    code += (
        "; import sys; sys.exit('flexneedle.phantom' in sys.modules or 'flexneedle.tracking' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_layers_forbid_control_to_import_the_phantom():
    """As neighbours in one independent layer of the contract that the linter checks."""
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8")
    (contract,) = tomllib.loads(text)["tool"]["importlinter"]["contracts"]
    assert contract["type"] == "layers"
    (layer,) = [layer for layer in contract["layers"] if "(control)" in layer]
    assert {"(control)", "(phantom)", "(tracking)"} <= {part.strip() for part in layer.split("|")}


# ---- bad readings


def lost(_sample):
    return None


def blind(sample):
    return replace(sample, x=None, y=None)


def garbled(sample):
    return replace(sample, y=math.nan)


def old(sample):
    return replace(sample, time=sample.time - 0.5)


def jumping(sample):
    return replace(sample, y=sample.y + 3.0)


FAULTS = {
    "missing: no reading": lost,
    "missing: tracker sees no tip": blind,
    "not a number": garbled,
    "stale: 0.500 s old": old,
    "innovation 3": jumping,
}


def between(first, last, fault):
    """Spoil the readings that were taken within [first, last) s."""

    def spoil(batch):
        spoilt = [fault(sample) if first <= sample.time < last else sample for sample in batch]
        return tuple(sample for sample in spoilt if sample is not None)

    return spoil


@pytest.mark.parametrize(("verdict", "fault"), FAULTS.items(), ids=FAULTS)
@pytest.mark.parametrize("begin", [1.99, 8.01])  # in air, in tissue
def test_bad_readings_hold_the_needle_until_good_ones_return(plan, verdict, fault, begin):
    tank = Tank(plan.bevel, spoil=between(begin, begin + 0.6, fault))
    done = run(plan, tank.rig())
    bad = [period for period in done.periods if period.verdict != "ok"]
    first = bad[0].index
    assert [period.index for period in bad] == list(range(first, first + len(bad)))  # one spell
    assert all(period.verdict[:11] == verdict[:11] for period in bad)
    assert begin < bad[0].time < begin + 0.25
    assert begin + 0.55 < bad[-1].time < begin + 0.65
    # The period in which it was noticed had moved; then nothing moves, nor is anything assimilated.
    held = done.periods[first + 1 : first + len(bad) + 1]
    assert [period.command for period in held] == [STILL] * len(held)
    assert [period.applied for period in held] == [STILL] * len(held)
    assert {period.decision for period in held} == {"held"}
    assert not [time for time, _ in tank.moves if bad[0].time - 1e-9 <= time < held[-1].time - 1e-9]
    assert len({period.true_tip for period in (bad[0], *held)}) == 1
    assert {period.innovation for period in bad} == {(0.0, 0.0)}
    for period in bad[1:]:
        np.testing.assert_allclose(period.estimate, bad[0].estimate, atol=1e-6)
        assert period.tip_load == bad[0].tip_load
    # With the first good reading it goes on, and arrives.
    resumed = done.periods[held[-1].index + 1]
    assert held[-1].verdict == "ok"
    assert resumed.command[0] > 0.0
    assert done.outcome == "done"
    assert done.true_error_mm < 1.0
    assert len(done.periods) - len(held) <= 1.1 * len(plan.controls)


@pytest.mark.parametrize(("verdict", "fault"), FAULTS.items(), ids=FAULTS)
def test_after_the_hold_limit_the_run_ends_with_its_record(plan, verdict, fault):
    tank = Tank(plan.bevel, spoil=between(3.01, math.inf, fault))
    done = run(plan, tank.rig())
    bad = [period for period in done.periods if period.verdict != "ok"]
    assert done.outcome == "held"
    assert done.reason.startswith("held for 1.0")
    assert verdict in done.reason
    assert "limit 1 s" in done.reason
    assert not done.reached
    assert bad[-1].index == done.periods[-1].index
    assert bad[-1].time - bad[0].time == pytest.approx(1.0, abs=1e-6)
    assert len(bad) == 41  # of 25 ms each after the first
    assert tank.moves[-1][0] < bad[0].time
    assert done.periods[0].verdict == "ok"


@pytest.mark.parametrize("limit", [0.1, 0.5, 12.0])  # 12 s are more readings than periods of a run
def test_hold_limit_is_the_scenarios(plan, limit):
    scenario = PHANTOM.with_values({"control.hold_limit_s": limit})
    done = run(plan, Tank(plan.bevel, spoil=between(1.0, math.inf, lost)).rig(), scenario)
    bad = [period.time for period in done.periods if period.verdict != "ok"]
    assert bad[-1] - bad[0] == pytest.approx(limit, abs=READING)


def test_a_second_spell_has_its_own_second(plan):
    """0.8 s twice with good readings between: no abort."""
    first, second = between(3.0, 3.8, lost), between(5.0, 5.8, lost)
    done = run(plan, Tank(plan.bevel, spoil=lambda batch: second(first(batch))).rig())
    assert done.outcome == "done"


def test_limits_of_age_and_innovation_are_the_scenarios(plan):
    def offset(sample):
        return replace(sample, time=sample.time - 0.05, y=sample.y + 0.5)

    def verdicts(scenario):
        done = run(plan, Tank(plan.bevel, spoil=between(8.0, 8.4, offset)).rig(), scenario)
        return {period.verdict.split()[0] for period in done.periods}

    assert verdicts(PHANTOM) == {"ok"}
    assert verdicts(PHANTOM.with_values({"control.innovation_limit_mm": 0.3})) == {"ok", "innovation"}
    assert verdicts(PHANTOM.with_values({"control.stale_after_s": 0.03})) == {"ok", "stale:"}


def spoilt_tape(tape, which, fault):
    """One reading of every batch with several is spoilt or left out."""
    changed = []
    for batch in tape:
        readings = list(batch)
        if len(readings) > 2:
            bad = fault(readings[which])
            readings[which : which + 1 or None] = [] if bad is None else [bad]
        changed.append(tuple(readings))
    return changed


@pytest.mark.parametrize("fault", [blind, garbled, jumping])
def test_a_bad_reading_among_good_ones_is_left_out(plan, real, fault):
    """Just as if it had never been there."""
    _, tank = real
    one, none = (run(plan, Stage(loop(spoilt_tape(tank.tape, 1, f))).rig()) for f in (fault, lost))
    assert list(map(facts, one.periods)) == list(map(facts, none.periods))
    assert one.outcome == "done"


def loop(tape):
    """The tape, and its last batch as often as asked for."""
    yield from tape
    while True:
        yield tape[-1]


def test_a_bad_last_reading_holds_although_earlier_ones_were_good(plan, real):
    _, tank = real
    done = run(plan, Stage(loop(spoilt_tape(tank.tape, -1, garbled))).rig())
    assert done.outcome == "held"
    assert done.periods[0].verdict == "not a number"


def test_a_bad_reading_at_the_target_depth_does_not_count_as_arrival(plan, real):
    """The needle is held there, and done with the next good reading."""
    done, tank = real
    *way, last = tank.tape
    held = run(plan, Stage(loop([*way, (garbled(last[-1]),), last])).rig())
    assert [period.verdict for period in held.periods[-2:]] == ["not a number", "ok"]
    assert len(held.periods) == len(done.periods) + 1
    assert held.outcome == "done"
    assert held.periods[-1].command == STILL


# ---- refusals and other ends


def missing_by(plan, miss):
    tips = plan.tips.copy()
    tips[-1] = plan.target[0], plan.target[1] + miss, tips[-1, 2]
    return replace(plan, tips=tips, limit="setup.max_guide_step_mm = 0.5")


def test_a_plan_that_misses_by_more_than_a_millimetre_is_refused_unless_forced(plan):
    tank = Tank(plan.bevel)
    with pytest.raises(RunError, match=r"misses the target by 1\.01 mm .*bound by setup\.max_guide_step_mm"):
        run(missing_by(plan, 1.01), tank.rig())
    assert tank.moves == []
    with pytest.raises(RunError):
        flexneedle.insert(PHANTOM, missing_by(plan, 1.01), seed=2001)
    assert run(missing_by(plan, 1.01), tank.rig(), force=True).periods
    assert run(missing_by(plan, 0.99), Tank(plan.bevel).rig()).periods


class Stuck(Stage):
    """A driver that doesn't move, and a tracker that sees that."""

    def __init__(self):
        super().__init__([])

    def apply(self, command, duration):
        super().apply(command, duration)
        return STILL

    def read(self):
        return (Sample(self.time, -28.5, 0.0),)


def test_a_needle_that_does_not_move_fails_after_four_times_the_planned_periods(plan):
    short = replace(plan, controls=plan.controls[:5], tips=plan.tips[:6])
    done = run(short, Stuck().rig(), force=True)
    assert done.outcome == "failed"
    assert "four times the planned periods" in done.reason
    assert len(done.periods) == 20
    assert {period.applied for period in done.periods} == {STILL}
    assert done.periods[0].command[0] > 0.0


def test_a_model_that_does_not_converge_ends_the_run(plan, monkeypatch):
    monkeypatch.setattr(State, "converged", property(lambda _: False))
    done = run(plan, Tank(plan.bevel).rig())
    assert done.outcome == "failed"
    assert done.reason.startswith("the model did not converge")
    assert len(done.periods) == 1
    assert not done.periods[0].converged


def test_the_end_of_the_stroke_ends_the_run_and_is_said(plan):
    short = PHANTOM.with_values({"setup.stroke_mm": 60.0, "target.depth_mm": 20.0})
    tank = Tank(plan.bevel, scenario=short)
    done = run(plan, tank.rig(), short)
    assert sum(command[0] for _, command in tank.moves) == pytest.approx(60.0, abs=0.01)
    left = plan.target[0] - done.periods[-1].estimate[0]
    assert done.reason.startswith(
        f"the stroke ends {left:.2f} mm before the target depth; missed the target by "
    )
    assert not done.reached


class Rounding(Tank):
    """A driver with a resolution of 0.05 mm in the guide."""

    def apply(self, command, duration):
        rounded = (*command[:3], round(command[3] / 0.05) * 0.05, command[4])
        return super().apply(rounded, duration)


def test_the_command_as_applied_is_recorded_and_believed(plan):
    tank = Rounding(plan.bevel)
    done = run(plan, tank.rig())
    assert any(period.command[3] != period.applied[3] for period in done.periods)
    applied = np.cumsum([period.applied[3] for period in done.periods])
    np.testing.assert_allclose([period.guide for period in done.periods], applied, atol=1e-12)
    np.testing.assert_allclose([period.base[0] for period in done.periods][-1], tank.phantom.state.base[0])
    assert done.outcome == "done"


def test_without_a_truth_the_true_error_is_not_known(plan, real):
    done = run(plan, Stage(real[1].tape).rig())
    assert math.isnan(done.true_error_mm)
    assert not done.reached
    assert {period.true_tip for period in done.periods} == {None}
    assert {period.true_strain_energy for period in done.periods} == {None}
    assert done.residual_mm == real[0].residual_mm


def test_virtual_rig_is_a_phantom_of_its_seed_behind_the_ports(plan):
    seeds = np.random.SeedSequence(4), np.random.SeedSequence(5)
    rig, again = (insertion.virtual_rig(PHANTOM, plan.bevel, *seeds) for _ in range(2))
    rig.driver.apply((1.0, 0.0, 0.0, 0.0, -1), 0.2)
    again.driver.apply((1.0, 0.0, 0.0, 0.0, -1), 0.2)
    assert rig.truth() == again.truth()
    samples = rig.tracker.read()
    assert samples == again.tracker.read()
    assert len(samples) == 8
    off = np.array([(s.x, s.y) for s in samples])[-1] - rig.truth().tip[:2]
    assert 0.0 < np.abs(off).max() < 0.2
