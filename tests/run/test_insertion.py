"""The closed loop against trackers and drivers that fail, and against no phantom at all."""

import dataclasses
import itertools
import math
import pkgutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import flexneedle
import flexneedle.control
from flexneedle.errors import InputError, RunError
from flexneedle.phantom import Phantom, draw
from flexneedle.ports import VISIBLE, Sample
from flexneedle.run import insertion
from flexneedle.run.rig import Rig, Seeds, virtual_rig
from flexneedle.simulator import State
from flexneedle.trace import Insertion
from flexneedle.tracking import NoisyTracker

PHANTOM = flexneedle.load_scenario("phantom")
STILL = (0.0, 0.0, 0.0, 0.0, -1)
READING = PHANTOM.tracker.period
HELD, RESTING = "held", "at rest for the last reading"


class Tank:
    """A phantom whose driver calls are counted, behind a tracker whose batches are changed and taped."""

    status = VISIBLE

    def __init__(self, bevel, seed=2000, spoil=lambda batch: batch, scenario=PHANTOM, delay=0.0):
        self.phantom = Phantom(draw(scenario, np.random.default_rng(seed)), bevel)
        self.spoil, self.tape, self.moves, self.applied = spoil, [], [], []
        noise = np.random.default_rng(seed + 1)
        jitter = scenario.tracker.jitter_per_axis
        self.eye = NoisyTracker(
            self.phantom.tip_at, self.phantom, scenario.tracker.period, jitter, noise, delay=delay
        )

    def read(self):
        if self.phantom.now() == 0.0:
            return self.eye.read()  # it looks before the needle moves
        self.tape.append(self.spoil(self.eye.read()))
        return self.tape[-1]

    def apply(self, command, duration):
        self.moves.append((self.phantom.now(), command))
        self.applied.append(self.phantom.apply(command, duration))
        return self.applied[-1]

    def rig(self):
        return Rig(self.phantom, self, self, self.phantom.condition)


class Stage:
    """No phantom: a clock that adds up, a driver and a tracker that play tapes; off tape commands are carried out."""

    status = VISIBLE

    def __init__(self, tape, applied=()):
        first = (Sample(0.0, -28.5, 0.0),)  # where the needle starts
        self.time, self.tape, self.applied = 0.0, itertools.chain([first], tape), iter(applied)

    def now(self):
        return self.time

    def wait(self, seconds):
        self.time += seconds

    def apply(self, command, duration):
        self.time += duration
        return next(self.applied, command)

    def read(self):
        return next(self.tape)

    def rig(self):
        return Rig(self, self, self)


@pytest.fixture(scope="module")
def plan():
    return flexneedle.plan(PHANTOM, (40.0, 5.0), seed=1)


@pytest.fixture(scope="module")
def real(plan):
    """An insertion against a phantom, and what its tracker said, at once."""
    tank = Tank(plan.bevel)
    return run(plan, tank.rig()), tank


@pytest.fixture(scope="module")
def late(plan):
    """The same with readings that come a control period late."""
    tank = Tank(plan.bevel, delay=0.2)
    return run(plan, tank.rig()), tank


@pytest.fixture(scope="module")
def replayed(plan, real):
    """What `real` was, without its phantom: only readings, and what the driver said that it did."""
    tank = real[1]
    return run(plan, Stage(tank.tape, tank.applied).rig())


@pytest.fixture(scope="module")
def thinned(plan, real):
    """The same where one reading of every batch is left out."""
    tank = real[1]
    return run(plan, Stage(loop(spoilt_tape(tank.tape, 1, lost)), tank.applied).rig())


@pytest.fixture(scope="module")
def inserted(plan):
    """Return the insertion of a seed in the virtual rig, each kind of it carried out once."""

    @cache
    def insert(seed, phantom="exact", controller="adaptive-mpc", threads=None, **values):
        scenario = PHANTOM.with_values({key.replace("__", "."): value for key, value in values.items()})
        return flexneedle.insert(
            scenario, plan, seed, phantom=phantom, controller=controller, threads=threads
        )

    return insert


def run(plan, rig, scenario=PHANTOM, seed=5, **options):
    return insertion.run(scenario, plan, rig, np.random.default_rng(seed), **options)


class Enough(Exception):
    """No need to carry out the rest."""


def first_periods(count, plan, rig, scenario=PHANTOM, **options):
    """The first periods of an insertion that is then broken off."""
    seen = []

    def watch(period):
        seen.append(period)
        if len(seen) == count:
            raise Enough

    with pytest.raises(Enough):
        run(plan, rig, scenario, on_period=watch, **options)
    return seen


def facts(period):
    """All of a period but its wall-clock durations, as values that compare."""
    names = [field.name for field in dataclasses.fields(period) if field.name != "durations"]
    values = {name: getattr(period, name) for name in names}
    return {k: repr(v) if not isinstance(v, np.ndarray) else v.tobytes() for k, v in values.items()}


def acted(period):
    """All of a period but the readings that it was made of."""
    return {name: value for name, value in facts(period).items() if name != "readings"}


def believed(period):
    """What the controller did and believed, without the truth."""
    return {name: value for name, value in facts(period).items() if not name.startswith("true_")}


def moving(done):
    """The periods in which the driver was asked to move."""
    return [period for period in done.periods if period.decision not in (HELD, RESTING)]


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
    assert [period.applied for period in done.periods] == tank.applied
    for period, batch in zip(done.periods, tank.tape, strict=True):
        assert period.sample == batch[-1]
        assert period.verdict == "ok"
        np.testing.assert_allclose(
            period.applied, period.command, atol=0.01
        )  # but for the motors' resolution
        assert period.shape.shape == (61, 3)
        assert period.decision
        assert math.isfinite(period.cost)
        assert period.spread > 0.0
        assert period.path[0] == pytest.approx(min(period.estimate[0], plan.tips[-1, 0]), abs=0.02)
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
        needed = period.command[0] / PHANTOM.setup.insertion_speed_mm_s
        assert needed - 1e-6 <= duration < needed + READING
        assert duration / READING == pytest.approx(round(duration / READING))


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

    def virtual_rig(_scenario, _bevel, seeds, phantom):
        drawn.extend(np.random.default_rng(seed).random() for seed in dataclasses.astuple(seeds))
        plants.append(phantom)

    def no_run(_scenario, plan, _rig, rng, *_args, **_options):
        drawn.append(rng.random())
        return Insertion(plan, 0, (), "done", "")

    monkeypatch.setattr(insertion, "virtual_rig", virtual_rig)
    monkeypatch.setattr(insertion, "run", no_run)
    for seed, phantom in ((0, "exact"), (1, "exact"), (0, "model")):
        insertion.insert(PHANTOM, plan, seed, phantom=phantom)
    assert len(set(drawn)) == 8
    assert drawn[:4] == drawn[8:]
    assert plants == ["exact", "exact", "model"]


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
    assert {"flexneedle.control.identification", "flexneedle.control.methods.adaptive_mpc"} <= set(modules)
    code = "; ".join([f"import {name}" for name in modules])
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
def test_a_bad_reading_among_good_ones_is_left_out(plan, real, thinned, fault):
    """Just as if it had never been there."""
    tank = real[1]
    one = run(plan, Stage(loop(spoilt_tape(tank.tape, 1, fault)), tank.applied).rig())
    assert list(map(acted, one.periods)) == list(map(acted, thinned.periods))
    assert one.outcome == "done"


def loop(tape):
    """The tape, and its last batch as often as asked for."""
    yield from tape
    while True:
        yield tape[-1]


def test_a_bad_last_reading_holds_although_earlier_ones_were_good(plan, real):
    _, tank = real
    done = run(plan, Stage(loop(spoilt_tape(tank.tape, -1, garbled)), tank.applied).rig())
    assert done.outcome == "held"
    assert done.periods[0].verdict == "not a number"


def test_a_bad_reading_at_the_target_depth_does_not_count_as_arrival(plan, real):
    """The needle is held there, and done with the next good reading."""
    done, tank = real
    *way, last = tank.tape
    again = (replace(last[-1], time=last[-1].time + READING),)
    held = run(plan, Stage([*way, (garbled(last[-1]),), again], tank.applied).rig())
    assert [period.verdict for period in held.periods[-2:]] == ["not a number", "ok"]
    assert len(held.periods) == len(done.periods) + 1
    assert held.outcome == "done"
    assert held.periods[-1].command == STILL


# ---- readings that come late or not at all


def test_after_the_last_move_it_rests_until_that_is_seen(plan, late):
    """The readings of the last move come a period later; the record ends with one of the needle at rest."""
    done, tank = late
    assert (done.outcome, done.reason) == ("done", "")
    rests = [period for period in done.periods if period.decision == RESTING]
    assert rests
    assert list(done.periods[-len(rests) :]) == rests
    arrival = done.periods[-len(rests) - 1]
    assert arrival.decision != RESTING
    assert arrival.estimate[0] >= plan.target[0] - PHANTOM.control.depth_tolerance_mm
    assert {(period.command, period.applied) for period in rests} == {(STILL, STILL)}
    assert len(tank.moves) == len(done.periods) - len(rests)
    assert {period.true_tip for period in rests} == {arrival.true_tip}
    assert done.periods[-1].sample.time > arrival.time - 1e-6
    assert all(period.sample.time < arrival.time - 1e-6 for period in done.periods[: -len(rests)])
    assert done.periods[-1].time == pytest.approx(arrival.time + 0.2)
    assert tank.phantom.now() == done.periods[-1].time
    off = np.subtract((done.periods[-1].sample.x, done.periods[-1].sample.y), arrival.true_tip[:2])
    assert np.abs(off).max() < 4.0 * PHANTOM.tracker.jitter_per_axis


def test_without_a_delay_there_is_no_rest(real):
    assert RESTING not in {period.decision for period in real[0].periods}


def test_late_readings_are_used_for_the_time_at_which_they_were_taken(late, real):
    """Innovations are as small as those of readings at once: a needle that moves 1 mm a period is not 1 mm off."""
    for done, tank in (late, real):
        off = np.array([period.innovation for period in done.periods[20:]])
        assert np.sqrt((off**2).mean(axis=0)).max() < 0.15
        assert all(period.verdict == "ok" for period in done.periods)
        assert tank.tape[30][-1].time == pytest.approx(
            done.periods[30].time - (0.2 if tank is late[1] else 0.0)
        )


def test_no_reading_of_a_batch_is_lost_for_having_been_on_its_way(plan, late):
    """The eldest are 0.375 s old when they are read, 0.3 s the limit: they came while the needle moved, and count."""
    done, tank = late

    def estimates(tape, scenario=PHANTOM):
        periods = first_periods(12, plan, Stage(tape, tank.applied).rig(), scenario)
        return [period.estimate for period in periods]

    real = [period.estimate for period in done.periods[:12]]
    patient = PHANTOM.with_values({"control.stale_after_s": 10.0})
    assert estimates(tank.tape) == real
    assert estimates(tank.tape, patient) == real
    assert estimates([batch[-1:] for batch in tank.tape]) != real


def test_a_bad_reading_of_the_needle_at_rest_holds_until_a_good_one(plan, late):
    """It has arrived all the same: no further move."""
    done, tank = late
    tape, rests = list(tank.tape), sum(period.decision == RESTING for period in done.periods)
    spoilt = tuple(map(blind, tape[-1]))
    again = [replace(sample, time=sample.time + READING) for sample in tape[-1]]
    held = run(plan, Stage([*tape[:-1], spoilt, again], tank.applied).rig())
    assert held.outcome == "done"
    assert len(held.periods) == len(done.periods) + 1
    assert [period.decision for period in held.periods[-rests - 1 :]] == [*[RESTING] * rests, HELD]
    assert [period.verdict for period in held.periods[-2:]] == ["missing: tracker sees no tip", "ok"]


def test_missing_readings_hold_the_needle_for_one_reading_each(plan, inserted):
    """A fifth of all, as the scenario says: whenever the newest sees no tip; the rest of the loop is as ever."""
    done = inserted(2001, phantom__missing_fraction=0.2)
    assert done.outcome == "done"
    blind = [period.index for period in done.periods if period.verdict == "missing: tracker sees no tip"]
    assert len(blind) > 5
    for index in blind:
        after = done.periods[index + 1]
        assert (after.decision, after.command) == (HELD, STILL)
        assert after.time - done.periods[index].time == pytest.approx(READING)
        assert after.true_tip == done.periods[index].true_tip
    assert {period.index for period in done.periods if period.decision == HELD} == {k + 1 for k in blind}
    assert len(moving(done)) <= 1.1 * len(plan.controls)
    assert done.true_error_mm < 1.0


def test_a_delay_beyond_the_age_limit_holds_from_the_start(inserted):
    """As the scenario says it: no reading younger than 0.3 s, none believed, nothing hidden."""
    done = inserted(2001, phantom__delay_periods=1.75)
    assert done.outcome == "held"
    assert "stale: 0.350 s old, limit 0.3 s" in done.reason
    assert done.periods[-1].time == pytest.approx(1.2)


@pytest.mark.parametrize("controller", ["open-loop", "bevel-only"])
def test_the_rest_does_not_depend_on_the_controller(inserted, controller):
    done = inserted(2003, controller=controller)
    assert (done.outcome, done.controller) == ("done", controller)
    assert done.periods[-1].decision in (RESTING, HELD)
    last = moving(done)[-1]
    assert done.periods[-1].sample.time > last.time - 1e-6


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
    for miss, force in ((1.01, True), (0.99, False)):
        assert first_periods(1, missing_by(plan, miss), Tank(plan.bevel).rig(), force=force)


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
    short = replace(plan, controls=plan.controls[:5], tips=plan.tips[:6], guide=plan.guide[:6])
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


def test_a_plant_that_does_not_converge_is_said_in_its_periods(plan):
    """It ends nothing, since a controller knows nothing of it; but no period of it passes as good."""
    tank = Tank(plan.bevel)
    lost_after = 1.0

    def truth():
        return tank.phantom.condition()._replace(converged=tank.phantom.now() < lost_after)

    in_air = replace(plan, target=(-20.0, 0.0))
    done = run(in_air, Rig(tank.phantom, tank, tank, truth), force=True)
    assert done.outcome == "done"
    assert [period.converged for period in done.periods] == [p.time < lost_after for p in done.periods]
    assert {period.converged for period in done.periods} == {True, False}


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
    advance = sum(period.applied[0] for period in done.periods)
    assert done.periods[-1].base[0] == pytest.approx(PHANTOM.start_base_x + advance)
    assert [period.applied for period in done.periods] == tank.applied
    assert done.outcome == "done"


def test_without_a_truth_the_true_error_is_not_known(real, replayed):
    assert math.isnan(replayed.true_error_mm)
    assert not replayed.reached
    assert {period.true_tip for period in replayed.periods} == {None}
    assert {period.true_strain_energy for period in replayed.periods} == {None}
    assert {period.true_stretch for period in replayed.periods} == {None}
    assert replayed.residual_mm == real[0].residual_mm


# ---- the virtual rig


def rig_of(seed=4, phantom="exact", **values):
    scenario = PHANTOM.with_values({key.replace("__", "."): value for key, value in values.items()})
    return virtual_rig(scenario, 1, Seeds(*map(np.random.SeedSequence, (seed, 5, 6))), phantom)


def test_virtual_rig_is_a_phantom_of_its_seed_behind_the_ports():
    rig, again, other = rig_of(), rig_of(), rig_of(seed=3)
    for one in (rig, again, other):
        one.driver.apply((1.0, 0.0, 0.0, 0.0, -1), 0.2)
    assert str(rig.truth()) == str(again.truth()) != str(other.truth())
    at_rest = rig.tracker.read()
    assert at_rest == again.tracker.read()
    assert len(at_rest) == 9  # the first was there at the start
    tip = rig.truth().tip[:2]
    rig.driver.apply((1.0, 0.0, 0.0, 0.0, -1), 0.2)
    samples = rig.tracker.read()
    assert len(samples) == 8
    off = np.array([(s.x, s.y) for s in samples])[-1] - tip  # of a period ago
    assert 0.0 < np.abs(off).max() < 0.2


@pytest.mark.parametrize("seed", range(3))
def test_the_rigs_tracker_has_the_bias_of_the_scenario(seed):
    """0.3 mm in one direction, to all readings alike; the truth is told without it."""
    quiet = {"phantom__tracker_bias_mm": 0.3, "tracker__jitter_mm": 0.0, "phantom__missing_fraction": 0.0}
    rig = rig_of(seed, **quiet)
    for _ in range(3):
        rig.clock.wait(0.5)
    off = np.array([(s.x, s.y) for s in rig.tracker.read()]) - rig.truth().tip[:2]
    np.testing.assert_allclose(np.hypot(*off.T), 0.3)
    assert np.ptp(off, axis=0).max() < 1e-9
    other = rig_of(seed + 10, **quiet)
    other.clock.wait(0.5)
    elsewhere = np.array([(s.x, s.y) for s in other.tracker.read()])[-1] - other.truth().tip[:2]
    assert np.abs(elsewhere - off[-1]).max() > 0.01


def test_the_rigs_tracker_misses_the_share_of_the_scenario():
    """One in a hundred as shipped, within four standard deviations."""
    rig = rig_of()
    rig.clock.wait(250.0)
    missing = sum(sample.x is None for sample in rig.tracker.read())
    assert abs(missing - 100) < 4.0 * math.sqrt(99.0)


def test_the_plant_is_the_one_that_was_asked_for():
    tips = {}
    for name in ("exact", "model"):
        rig = rig_of(phantom=name)
        for _ in range(35):
            rig.driver.apply((1.0, 0.0, 0.0, 0.1, -1), 0.2)
        tips[name] = rig.truth().tip
    apart = np.hypot(*(tips["exact"] - tips["model"])[:2])
    assert 1e-3 < apart < 2.0  # a bend of 0.5 mm and the like lie between them
