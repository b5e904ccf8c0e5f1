"""The observer that fits the model: on needles of the model's own kind with other constants, it finds what they do."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

import flexneedle
from flexneedle.control import identification as idn
from flexneedle.control.adaptive_settings import AdaptiveMpc
from flexneedle.control.identification import (
    BASE_TURN,
    BASE_Y,
    BEND,
    BEVEL,
    MODULUS,
    RUN_OUT,
    Identification,
)
from flexneedle.errors import ScenarioError
from flexneedle.mechanics import needle as nd
from flexneedle.ports import Sample
from flexneedle.simulator import Control, Learnt, Simulator
from tasks import begun_with

PHANTOM = flexneedle.load_scenario("phantom")
QUIET = PHANTOM.with_values({"tracker.jitter_mm": 1e-3, "control.adaptive_mpc.model_sd_mm": 3e-3})
TURNS = (20, 40, 52)  # moves that turn the bevel, the first in air
LAYERS = len(PHANTOM.tissue)
SHIFT = MODULUS + LAYERS
CELLS = SHIFT + LAYERS - 1
OWN = AdaptiveMpc()
WAVES = tuple(
    (1.0 + 0.5 * np.sin(0.45 * np.arange(15))).tolist()
)  # factors on the modulus in cells of 2.5 mm


def commands(count):
    """Advance by 1 mm a move; the guide goes here and there."""
    guide = 0.12 * np.sin(0.35 * np.arange(count)) + 0.05
    return [(1.0, 0.0, 0.0, float(guide[k]), 1 if k in TURNS else -1) for k in range(count)]


@dataclass(frozen=True)
class Needle:
    """What a needle of the model's kind, and its tissue, have of their own."""

    base_y: float = 0.0
    base_turn: float = 0.0
    bend: float = 0.0
    run_out: float = 0.0
    modulus: tuple[float, ...] = (1.0, 1.0)
    shift: tuple[float, ...] = (0.0,)
    variation: tuple[float, ...] = field(default=(1.0,), repr=False)
    bevel: float = 1.0

    def inserted(self, scenario, rows):
        """States before and after each row, stepped one by one."""
        simulator = self.simulator(scenario)
        state = Simulator(scenario, 1).start().believing(base_y=self.base_y, base_turn=self.base_turn)
        states = [simulator.step(state, Control())]
        for row in rows:
            states.append(simulator.step(states[-1], Control.from_row(row)))
        return states

    def simulator(self, scenario):
        """The simulator with this needle's constants."""
        tissue = np.array(self.shift), np.array(self.modulus), 2.5, np.array(self.variation)
        return Simulator(scenario, threads=1).adapted(Learnt(*tissue, self.bevel, self.bend))

    def seen(self, state):
        """Tip (x, y) as a tracker sees it."""
        return np.add(state.tip[:2], [0.0, self.run_out * state.bevel])


NEEDLES = {
    "base offset": Needle(base_y=0.5),
    "base turn": Needle(base_turn=-3e-3),
    "bend": Needle(bend=0.6),
    "run-out": Needle(run_out=-0.15),
    "modulus": Needle(modulus=(1.6, 1.5)),
    "bevel": Needle(bevel=1.4),
    "modulus along the depth": Needle(variation=WAVES),
    "all": Needle(-0.4, 2e-3, -0.4, 0.1, (0.8, 1.3), (1.3,), WAVES, 0.7),
}


def readings(needle, before, after, start, count, noise, rng):
    """Of an even move of one second; a bevel turns before its move, and the run-out with it."""
    parts = (np.arange(count) + 1) / count
    out = needle.seen(after) - after.tip[:2]
    first, last = before.tip[:2] + out, after.tip[:2] + out
    points = [first + part * (last - first) + rng.normal(0.0, noise, 2) for part in parts]
    return [Sample(float(start + part), *point.tolist()) for part, point in zip(parts, points, strict=True)]


def followed(needle, count, *, scenario=QUIET, noise=0.0, late=0, threads=1, per_move=2):
    """The belief after so many moves, the readings coming so many moves late; the needle's states."""
    rows, rng = commands(count), np.random.default_rng(2)
    states = needle.inserted(scenario, rows)
    estimate = Identification().begin(begun_with(Simulator(scenario, threads), 1))
    batches = [readings(needle, states[k], states[k + 1], k, per_move, noise, rng) for k in range(len(rows))]
    for k, row in enumerate(rows):
        estimate = estimate.move(row, k, k + 1.0)
        if k >= late:
            estimate = estimate.observe(batches[k - late])
    for batch in batches[count - late :] if late else ():
        estimate = estimate.observe(batch)
    return estimate, states


def ahead(estimate, needle, states, scenario=QUIET, steps=8):
    """Errors (mm) of the seen tip after some steps on, of the belief and of the uncorrected model; no readings."""
    nominal, own = Simulator(scenario, threads=1), needle.simulator(scenario)
    naive = nominal.start()
    for row in commands(len(states) - 1):
        naive = nominal.step(naive, Control.from_row(row))
    truth = states[-1]
    for k in range(steps):
        row = (1.0, 0.0, 0.0, 0.1, -1)
        truth = own.step(truth, Control.from_row(row))
        naive = nominal.step(naive, Control.from_row(row))
        estimate = estimate.move(row, 100.0 + k, 101.0 + k)
    goal = needle.seen(truth)[1]
    return abs(estimate.tip[1] - goal), abs(naive.tip[1] - goal)


# ---- what is found


def test_it_begins_with_the_scenario():
    estimate = Identification().begin(begun_with(Simulator(PHANTOM, 1), -1))
    np.testing.assert_array_equal(estimate.tip, [-28.5, 0.0, 0.0])
    cells = int(np.ceil(81.5 / OWN.cell_mm))  # to the end of the stroke
    assert estimate.parameters.size == CELLS + cells
    np.testing.assert_array_equal(np.flatnonzero(estimate.parameters), [BEVEL])
    assert estimate.parameters[BEVEL] == 1.0
    assert estimate.state.bevel == -1
    assert estimate.innovation == (0.0, 0.0)
    assert estimate.measured is None


def test_readings_of_the_scenarios_own_needle_leave_the_prior_mean():
    estimate, states = followed(Needle(), 60, scenario=PHANTOM)
    np.testing.assert_allclose(estimate.parameters, estimate.prior.mean, atol=1e-7)
    np.testing.assert_allclose(estimate.tip, states[-1].tip, atol=1e-7)
    assert estimate.residual == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("needle", NEEDLES.values(), ids=NEEDLES)
def test_it_predicts_a_needle_with_other_constants(needle):
    """8 mm on, without a reading; what varies along the depth is known only as far as it is correlated."""
    estimate, states = followed(needle, 70)
    x, y = needle.seen(states[-1])
    varied = len(needle.variation) > 1
    assert estimate.tip[0] == pytest.approx(x, abs=0.03)
    assert estimate.tip[1] == pytest.approx(y, abs=5e-3 if varied else 1e-3)
    learnt, naive = ahead(estimate, needle, states)
    assert naive > 0.1
    assert learnt < (0.12 if varied else 0.05)
    assert learnt < (0.4 if varied else 0.1) * naive


@pytest.mark.parametrize("name", ["all", "modulus along the depth"])
def test_it_predicts_with_the_noise_of_a_tracker_too(name):
    noise = PHANTOM.tracker.jitter_per_axis
    estimate, states = followed(NEEDLES[name], 70, scenario=PHANTOM, noise=noise, per_move=8)
    learnt, naive = ahead(estimate, NEEDLES[name], states, PHANTOM)
    assert learnt < 0.15
    assert learnt < 0.4 * naive


def test_a_displaced_boundary_is_found():
    """Between layers that differ much, with the noise of a tracker; 3 mm are two standard deviations."""
    needle, noise = Needle(modulus=(1.0, 2.0), shift=(-3.0,)), PHANTOM.tracker.jitter_per_axis
    estimate, states = followed(needle, 70, scenario=PHANTOM, noise=noise, per_move=8)
    assert estimate.parameters[SHIFT] == pytest.approx(-3.0, abs=1.0)
    learnt, naive = ahead(estimate, needle, states, PHANTOM)
    assert learnt < 0.1 * naive


def test_the_modulus_along_the_depth_is_found():
    """What layer and cell have together, where the tip has been: it rises and falls as that of the tissue does."""
    estimate, _ = followed(NEEDLES["modulus along the depth"], 66)
    found = estimate.parameters[CELLS : CELLS + 14]
    layers = estimate.parameters[MODULUS:SHIFT][np.arange(14) // 8]
    np.testing.assert_allclose((found + layers)[:13], np.log(WAVES[:13]), atol=0.15)
    assert np.ptp(np.log(WAVES[:13])) > 0.9


def test_what_lies_ahead_of_the_tip_is_believed_as_far_as_it_is_correlated():
    """Towards the prior's mean by exp(−cell/length) a cell."""
    for needle, length in (("modulus along the depth", 10.0), ("all", 4.0)):
        scenario = QUIET.with_values({"control.adaptive_mpc.variation_length_mm": length})
        estimate, _ = followed(NEEDLES[needle], 66, scenario=scenario)
        last = int(estimate.tips[:-1, 0].max() // 2.5)
        cells = estimate.parameters[CELLS + last :]
        assert abs(cells[0]) > 0.05
        # The fit knew the tip's depth of before its last step, in which the tip may reach a cell for the first time.
        np.testing.assert_allclose(
            cells[2:], cells[1] * np.exp(-2.5 / length * np.arange(1, cells.size - 1)), rtol=1e-6
        )


def test_what_the_readings_tell_apart_is_found():
    """Run-out jumps with the bevel; the rest shows along the way, some of it only in part."""
    needle = NEEDLES["all"]
    estimate, _ = followed(needle, 70)
    found = estimate.parameters
    assert found[RUN_OUT] == pytest.approx(needle.run_out, abs=0.02)
    assert np.sign(found[[BASE_Y, BEND]]).tolist() == [np.sign(needle.base_y), np.sign(needle.bend)]


def test_a_base_offset_alone_is_told_by_its_lever():
    """In air the tip goes y = b (1 − lever): what base y and turn do to it together is found, not each."""
    needle = Needle(base_y=0.5)
    estimate, states = followed(needle, 20)
    np.testing.assert_allclose(estimate.tip, states[-1].tip, atol=1e-3)
    assert abs(estimate.parameters[BASE_Y]) + 100.0 * abs(estimate.parameters[BASE_TURN]) > 0.2


@pytest.mark.parametrize("layers", [1, 3])
def test_tissue_of_other_layers_is_identified_too(layers):
    """One without a boundary, and three with two, the upper of which is displaced to below where the lower was."""
    top = PHANTOM.values()["tissue"][0]
    kinds = [
        {**top, "name": str(k), "thickness_mm": 8.0, "shear_modulus_kpa": 1.82 * (1 + k)}
        for k in range(layers)
    ]
    scenario = PHANTOM.with_values({"tissue": kinds})
    needle = Needle(
        base_y=0.3, modulus=(1.5, 0.8, 1.4)[:layers], shift=(8.5, 2.0)[: layers - 1], variation=WAVES
    )
    estimate, states = followed(needle, 65, scenario=scenario)
    assert estimate.parameters.size == MODULUS + 2 * layers - 1 + 33
    assert estimate.prior.mean.shape == estimate.prior.steps.shape == estimate.prior.begins.shape
    learnt, naive = ahead(estimate, needle, states, scenario)
    assert naive > 0.1
    assert learnt < 0.3 * naive
    assert estimate.state.converged


def test_a_tracker_without_jitter_is_believed_but_for_what_no_parameter_explains():
    scenario = PHANTOM.with_values({"tracker.jitter_mm": 0.0})
    estimate, states = followed(NEEDLES["all"], 66, scenario=scenario)
    np.testing.assert_array_equal(estimate._readings.variance(scenario, OWN), OWN.model_sd_mm**2)
    assert estimate.tip[1] == pytest.approx(NEEDLES["all"].seen(states[-1])[1], abs=0.01)


def test_more_noise_means_less_is_believed():
    """One reading 0.1 mm off: in a noisy tracker's case the tip moves less."""
    moved = []
    for jitter in (1e-3, 0.05, 0.5):
        scenario = PHANTOM.with_values({"tracker.jitter_mm": jitter})
        estimate = (
            Identification()
            .begin(begun_with(Simulator(scenario, 1), 1))
            .move((1.0, 0.0, 0.0, 0.0, -1), 0.0, 1.0)
        )
        moved.append(estimate.observe([Sample(1.0, -27.5, 0.1)]).tip[1])
    assert 0.1 > moved[0] > moved[1] > moved[2] > 0.0


# ---- its prior


def test_the_prior_is_that_of_the_scenario():
    """Standard deviations one by one, and for the cells the inverse of their exponential correlation."""
    sds = {
        "control.start_offset_sd_mm": 0.6, "control.start_angle_sd_mrad": 2.0, "control.adaptive_mpc.bend_sd_mm": 0.7,
        "control.adaptive_mpc.run_out_sd_mm": 0.2, "control.adaptive_mpc.bevel_sd": 0.4,
        "control.adaptive_mpc.modulus_log_sd": 0.25, "control.adaptive_mpc.boundary_sd_mm": 1.1,
        "control.adaptive_mpc.variation_sd": 0.15, "control.adaptive_mpc.variation_length_mm": 7.0,
        "control.adaptive_mpc.cell_mm": 4.0,
    }  # fmt: skip
    scenario = PHANTOM.with_values(sds)
    prior = idn._Prior.of(scenario, begun_with(Simulator(scenario, 1)).settings)
    cells = 21  # of 4 mm in 81.5 mm
    apart = 4.0 * np.abs(np.subtract.outer(np.arange(cells), np.arange(cells)))
    covariance = np.zeros((CELLS + cells, CELLS + cells))
    covariance[:CELLS, :CELLS] = np.diag(np.square([0.6, 2e-3, 0.7, 0.2, 0.4, 0.25, 0.25, 1.1]))
    covariance[CELLS:, CELLS:] = 0.15**2 * np.exp(-apart / 7.0)
    np.testing.assert_allclose(prior.precision @ covariance, np.eye(CELLS + cells), atol=1e-9)
    np.testing.assert_array_equal(prior.mean, np.arange(CELLS + cells) == BEVEL)
    sd = np.sqrt(np.diag(covariance))
    expected = prior.mean + np.outer([-4.0, 4.0], sd)
    expected[:, BEVEL] = 0.0, 0.7 * 20.0 / 4.0 - 0.1  # below what a scenario may ask for
    np.testing.assert_allclose(prior.bounds, expected)
    off = np.random.default_rng(1).normal(size=sd.size) * sd
    assert prior.cost(prior.mean + off) == pytest.approx(0.5 * off @ np.linalg.solve(covariance, off))


@pytest.mark.parametrize(("size", "distance"), [(2, 0.3), (3, 2.0), (7, 0.25), (40, 0.01)])
def test_precision_of_a_chain_is_the_inverse_of_its_correlation(size, distance):
    correlation = np.exp(-distance * np.abs(np.subtract.outer(np.arange(size), np.arange(size))))
    np.testing.assert_allclose(
        idn._uncorrelating(size, distance), np.linalg.inv(correlation), rtol=1e-9, atol=1e-9
    )


def test_what_is_known_for_sure_is_not_fitted():
    """Standard deviations of 0."""
    sure = {
        f"control.adaptive_mpc.{key}": 0.0
        for key in (
            "bend_sd_mm",
            "run_out_sd_mm",
            "modulus_log_sd",
            "bevel_sd",
            "boundary_sd_mm",
            "variation_sd",
        )
    }
    estimate, _ = followed(NEEDLES["all"], 50, scenario=PHANTOM.with_values(sure))
    moved = np.abs(estimate.parameters - estimate.prior.mean)
    assert moved[BASE_Y] + 100.0 * moved[BASE_TURN] > 0.05
    assert moved[BEND:].max() < 1e-5


# ---- its parts


def off_the_prior(count=55, needle="all"):
    """A belief after some moves with parameters that are neither the prior's nor fitted, and its readings."""
    estimate, _ = followed(NEEDLES[needle], count)
    sd = np.sqrt(1.0 / np.diag(estimate.prior.precision))
    off = np.random.default_rng(3).normal(0.0, 0.2, sd.size) * sd
    belief = estimate._with(estimate.parameters + off)
    return belief, belief._readings


def learnt_of(parameters):
    """What the parameters say of tissue and needle."""
    tissue = parameters[SHIFT:CELLS], np.exp(parameters[MODULUS:SHIFT]), 2.5, np.exp(parameters[CELLS:])
    return Learnt(*tissue, float(parameters[BEVEL]), float(parameters[BEND]))


def stepped(parameters, rows):
    """States of a needle with these parameters, the start first, moved one step after another."""
    nominal = Simulator(QUIET, 1)
    simulator = nominal.adapted(learnt_of(parameters))
    state = nominal.start().believing(base_y=parameters[BASE_Y], base_turn=parameters[BASE_TURN])
    states = [simulator.step(state, Control())]
    for row in rows:
        states.append(simulator.step(states[-1], Control.from_row(row)))
    return states


def predicted(parameters, rows, seen):
    """Readings of such a needle: at even moves, and on the bevel's side of its axis."""
    states = stepped(parameters, rows)
    y = np.array([state.tip[1] for state in states])
    side = np.array([state.bevel for state in states])
    ends = y[seen.index + 1]
    return y[seen.index] + seen.part * (ends - y[seen.index]) + parameters[RUN_OUT] * side[seen.index + 1]


def test_jacobian_agrees_with_central_differences():
    """Of the readings, by every parameter, at parameters off the prior; closely with small steps."""
    belief, seen = off_the_prior()
    fine = replace(belief, prior=replace(belief.prior, steps=1e-3 * belief.prior.steps))
    jacobian, close = idn._jacobian(belief, seen), idn._jacobian(fine, seen)
    assert jacobian.shape == (seen.y.size, belief.parameters.size)
    for k in range(CELLS + 12):
        step = np.zeros(belief.parameters.size)
        step[k] = 1e-3 * belief.prior.steps[k]
        ends = (predicted(belief.parameters + sign * step, commands(55), seen) for sign in (1.0, -1.0))
        central = np.subtract(*ends) / (2.0 * step[k])
        scale = np.abs(central).max()
        np.testing.assert_allclose(close[:, k], central, atol=2e-3 * scale + 1e-7)
        # Half a step of a boundary may lie across the middle of a contact's interval, where the slope jumps.
        off = 0.25 if SHIFT <= k < CELLS else 0.03
        assert np.linalg.norm(jacobian[:, k] - central) <= off * np.linalg.norm(central) + 1e-6
    deepest = belief.tips[:, 0].max()
    np.testing.assert_array_equal(jacobian[:, CELLS + int(deepest // 2.5) + 1 :], 0.0)


def test_jacobian_from_the_stops_is_that_from_the_start():
    """What is not simulated again does not depend on the parameter."""
    belief, seen = off_the_prior(66)
    assert len(belief.stops) > 4
    whole = replace(belief, stops=belief.stops[:1])
    again = replace(whole, prior=replace(belief.prior, begins=np.full_like(belief.prior.begins, -np.inf)))
    jacobian = idn._jacobian(belief, seen)
    np.testing.assert_allclose(jacobian, idn._jacobian(whole, seen), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(jacobian, idn._jacobian(again, seen), rtol=1e-6, atol=1e-7)
    assert np.abs(jacobian[:, CELLS + 12]).max() > 1e-4


def test_the_stops_are_states_of_the_way():
    """Bit for bit those of stepping, at the start, before the move into the tissue, and every eight moves in it."""
    belief, _ = off_the_prior(60)
    states = stepped(belief.parameters, commands(60))
    assert [first for first, _ in belief.stops] == [0, 28, 36, 44, 52]
    for first, state in belief.stops:
        assert state == states[first]
    np.testing.assert_array_equal(belief.tips, [state.tip for state in states])


def test_one_step_is_the_maximum_a_posteriori_of_the_linear_problem():
    """Least squares of readings and prior stacked, each over its standard deviation."""
    belief, seen = off_the_prior(45, "bend")
    sd = np.sqrt(QUIET.tracker.jitter_per_axis**2 / seen.count + belief.settings.model_sd_mm**2)
    prior = np.linalg.cholesky(belief.prior.precision).T
    jacobian = idn._jacobian(belief, seen)
    matrix = np.concatenate([jacobian / sd[:, None], prior])
    missing = seen.y - predicted(belief.parameters, commands(45), seen)
    right = np.concatenate([missing / sd, prior @ (belief.prior.mean - belief.parameters)])
    step = np.linalg.lstsq(matrix, right, rcond=None)[0]
    assert (np.abs(step) > 1e-4).sum() > 10
    found = idn._improved(belief, seen).parameters
    np.testing.assert_allclose(found, belief.parameters + step, rtol=1e-6, atol=1e-8)


def test_cells_are_not_so_short_that_a_fit_would_never_end():
    short = begun_with(Simulator(PHANTOM.with_values({"control.adaptive_mpc.cell_mm": 1e-3}), 1))
    with pytest.raises(
        ScenarioError, match=r"^control.adaptive_mpc.cell_mm = 0.001: must be at least 0.4075, "
    ):
        Identification().begin(short)


# ---- its step back


def misfit(belief, readings=None):
    """What the fit makes least: squares over variances, halved."""
    readings = readings or belief._readings
    variance = readings.variance(belief.nominal.scenario, belief.settings)
    off = belief.parameters - belief.prior.mean
    rows, p = np.array([done.applied for done in belief.moves]), belief.parameters
    y = belief.tips[:, 1]
    y = y[readings.index] + readings.part * (y[readings.index + 1] - y[readings.index])
    first = belief.stops[0][1].bevel
    sides = first * np.cumprod(np.where(rows[:, 4] > 0.0, -1.0, 1.0))[readings.index]
    left = readings.y - y - p[RUN_OUT] * sides
    return 0.5 * (left**2 / variance).sum() + 0.5 * off @ belief.prior.precision @ off


def test_a_step_never_fits_worse(monkeypatch):
    """Over whole insertions, one with readings that jump from side to side."""
    costs, tried, improved, with_ = [], [], idn._improved, idn.Identified._with

    def spied(belief, seen):
        tried.append(0)
        fitted = improved(belief, seen)
        costs.append((misfit(belief, seen), misfit(fitted, seen)))
        return fitted

    def counted(belief, parameters):
        tried[-1] += 1
        return with_(belief, parameters)

    monkeypatch.setattr(idn, "_improved", spied)
    monkeypatch.setattr(idn.Identified, "_with", counted)
    for scenario, jump in ((PHANTOM, 1.0), (QUIET, 0.1)):
        estimate, states = (
            Identification().begin(begun_with(Simulator(scenario, 1), 1)),
            Needle().inserted(scenario, commands(50)),
        )
        for k, row in enumerate(commands(50)):
            x, y = states[k + 1].tip[:2].tolist()
            off = jump * (-1) ** (k // 5)
            estimate = estimate.move(row, k, k + 1.0).observe([Sample(k + 1.0, x, y + off)])
    before, after = np.array(costs).T
    assert (after <= before * (1.0 + 1e-9) + 1e-12).all()
    assert len(set(tried)) >= 3
    assert sum(tried) < 4 * len(tried)


@pytest.mark.parametrize("factor", [-1.0, 1e-3])
def test_a_wrong_step_is_not_taken(monkeypatch, factor):
    """A Jacobian that leads to a step the other way, or far too far: no parameter moves for the worse."""
    belief, seen = off_the_prior(45)
    jacobian = idn._jacobian
    monkeypatch.setattr(idn, "_jacobian", lambda *args: factor * jacobian(*args))
    fitted = idn._improved(belief, seen)
    assert misfit(fitted, seen) <= misfit(belief, seen) * (1.0 + 1e-12)


def spoilt(belief):
    return replace(belief, tips=np.full_like(belief.tips, np.nan))


def test_a_trial_step_that_ends_in_nan_is_refused(monkeypatch):
    belief, seen = off_the_prior(45)
    with_, tried = idn.Identified._with, []

    def failing(self, parameters):
        tried.append(parameters)
        other = with_(self, parameters)
        return spoilt(other) if len(tried) <= 2 else other

    monkeypatch.setattr(idn.Identified, "_with", failing)
    fitted = idn._improved(belief, seen)
    assert len(tried) >= 3
    assert np.isfinite(fitted.tips).all()
    assert misfit(fitted, seen) <= misfit(belief, seen)


def test_if_no_trial_step_can_be_had_the_parameters_stay(monkeypatch):
    belief, seen = off_the_prior(45)
    with_ = idn.Identified._with

    def failing(self, parameters):
        other = with_(self, parameters)
        return other if np.array_equal(parameters, belief.parameters) else spoilt(other)

    monkeypatch.setattr(idn.Identified, "_with", failing)
    fitted = idn._improved(belief, seen)
    np.testing.assert_array_equal(fitted.parameters, belief.parameters)
    np.testing.assert_array_equal(fitted.tips, belief.tips)


def test_a_trial_step_that_does_not_converge_is_refused(monkeypatch):
    belief, seen = off_the_prior(45)
    with_ = idn.Identified._with

    def failing(self, parameters):
        other = with_(self, parameters)
        if np.array_equal(parameters, belief.parameters):
            return other
        scalars = other.state.scalars.copy()
        scalars[nd.CONVERGED] = 0.0
        return replace(other, state=replace(other.state, scalars=scalars))

    monkeypatch.setattr(idn.Identified, "_with", failing)
    assert idn._improved(belief, seen).state.converged


def test_a_jacobian_that_is_not_finite_leaves_the_parameters(monkeypatch):
    belief, seen = off_the_prior(45)
    monkeypatch.setattr(idn, "_jacobian", lambda *_: np.full((seen.y.size, belief.parameters.size), np.nan))
    np.testing.assert_array_equal(idn._improved(belief, seen).parameters, belief.parameters)


# ---- its readings


def test_readings_of_a_move_are_averaged_at_their_mean_time():
    estimate = Identification().begin(begun_with(Simulator(PHANTOM, 1), 1))
    for k in range(2):
        estimate = estimate.move((1.0, 0.0, 0.0, 0.0, -1), 2.0 * k, 2.0 * k + 2.0)
    seen = [Sample(2.5, -27.3, 0.1), Sample(3.5, -26.7, 0.3)]
    means = estimate.observe(seen)._readings
    assert (means.index.tolist(), means.count.tolist()) == ([1], [2.0])
    assert (means.part[0], means.x[0], means.y[0]) == pytest.approx((0.5, -27.0, 0.2))
    np.testing.assert_allclose(means.between(np.array([0.0, 10.0, 20.0])), [15.0])


@pytest.mark.parametrize("first", [1, -1])
def test_a_reading_is_on_the_side_to_which_the_bevel_turned_before_its_move(first):
    estimate = Identification().begin(begun_with(Simulator(PHANTOM, 1), first))
    for k, flip in enumerate((-1, 1, -1, 1, -1)):
        estimate = estimate.move((1.0, 0.0, 0.0, 0.0, flip), float(k), k + 1.0)
    seen = [Sample(k + 0.5, -28.0 + k, 0.0) for k in (0, 1, 3, 4)]
    means = estimate.observe(seen)._readings
    np.testing.assert_array_equal(means.index, [0, 1, 3, 4])
    np.testing.assert_array_equal(means.sides, np.multiply(first, [1, -1, 1, 1]))


def test_the_low_pass_follows_the_newest_and_forgets():
    gain = OWN.residual_gain
    assert idn._low_passed(OWN, np.array([1.0])) == pytest.approx(gain)
    assert idn._low_passed(OWN, np.array([1.0, 0.0])) == pytest.approx(gain * (1.0 - gain))
    assert idn._low_passed(OWN, np.full(200, 0.3)) == pytest.approx(0.3, rel=0.01)
    assert idn._low_passed(OWN, np.zeros(0)) == 0.0


# ---- what holds whatever the readings


@pytest.mark.parametrize("off", [1.9, -1.9])
def test_parameters_stay_within_four_standard_deviations(off):
    """Readings far aside, in air and in tissue, and a solve that still converges."""
    rows = commands(50)
    states = Needle().inserted(PHANTOM, rows)
    estimate = Identification().begin(begun_with(Simulator(PHANTOM, 1), 1))
    for k, row in enumerate(rows):
        estimate = estimate.move(row, k, k + 1.0)
        x, y = states[k + 1].tip[:2]
        estimate = estimate.observe([Sample(k + 1.0, float(x), float(y) + off * (-1) ** (k // 10))])
        found = estimate.parameters
        assert abs(found[BASE_Y]) <= 4.0 * 0.5 + 1e-12
        assert abs(found[BASE_TURN]) <= 4.0 * 3e-3 + 1e-12
        assert abs(found[BEND]) <= 4.0 * OWN.bend_sd_mm + 1e-12
        assert abs(found[RUN_OUT]) <= 4.0 * OWN.run_out_sd_mm + 1e-12
        assert np.abs(found[MODULUS:SHIFT]).max() <= 4.0 * OWN.modulus_log_sd + 1e-12
        assert np.abs(found[SHIFT:CELLS]).max() <= 4.0 * OWN.boundary_sd_mm + 1e-12
        assert np.abs(found[CELLS:]).max() <= 4.0 * OWN.variation_sd + 1e-12
        # An offset of 0.7 of the compression length is the furthest that a scenario may ask for.
        assert 0.0 <= found[BEVEL] * 4.0 <= 0.7 * 20.0
        assert estimate.state.converged
        assert np.isfinite(estimate.tip).all()


def test_mirrored_readings_give_the_mirrored_belief():
    needle, rows = NEEDLES["all"], commands(45)
    states = needle.inserted(PHANTOM, rows)
    here, there = (Identification().begin(begun_with(Simulator(PHANTOM, 1), side)) for side in (1, -1))
    for k, row in enumerate(rows):
        away = (*row[:3], -row[3], row[4])
        batch = readings(needle, states[k], states[k + 1], k, 2, 0.0, np.random.default_rng(0))
        here = here.move(row, k, k + 1.0).observe(batch)
        there = there.move(away, k, k + 1.0).observe([replace(s, y=-s.y) for s in batch])
    np.testing.assert_allclose(there.tip, here.tip * [1.0, -1.0, -1.0], atol=1e-6)
    turned = np.where(np.isin(np.arange(here.parameters.size), (BASE_Y, BASE_TURN)), -1.0, 1.0)
    np.testing.assert_allclose(there.parameters, turned * here.parameters, atol=1e-4)


def test_a_turn_of_the_bevel_turns_bend_and_run_out_over():
    """In air: a believed bend of the free needle and a run-out show on the other side."""
    scenario = PHANTOM.with_values({"setup.guide_to_skin_mm": None})
    simulator = Simulator(scenario, 1)
    estimate = Identification().begin(begun_with(simulator, 1))
    parameters = estimate.parameters.copy()
    parameters[[BEND, RUN_OUT]] = 0.6, 0.1
    adapted = simulator.adapted(Learnt(np.zeros(1), np.ones(2), bend=0.6))
    state = adapted.step(simulator.start(), Control())
    bent = replace(estimate, simulator=adapted, state=state, parameters=parameters)
    assert bent.tip[1] == pytest.approx(0.7, abs=1e-4)  # the bend shortens the needle a little
    turned = bent.move((0.1, 0.0, 0.0, 0.0, 1), 0.0, 1.0)
    np.testing.assert_allclose(turned.tip[1:], -bent.tip[1:], atol=1e-9)
    assert bent.off_axis(-1) == pytest.approx(-bent.off_axis(1))
    left = replace(bent, residual=0.03)
    assert (left.off_axis(1), left.off_axis(-1)) == pytest.approx((0.13, -0.07))


def test_a_bevel_turns_before_its_move_and_so_does_the_run_out():
    """A needle that is known, run-out included, is still known after readings in the midst of a turn's move."""
    needle = NEEDLES["run-out"]
    estimate, _ = followed(needle, 20)
    assert commands(21)[20][4] == 1
    before, after = needle.inserted(QUIET, commands(21))[20:22]
    moved = estimate.move(commands(21)[20], 20.0, 21.0)
    assert moved.tip[1] == pytest.approx(needle.seen(after)[1], abs=2e-3)
    corrected = moved.observe(readings(needle, before, after, 20, 4, 0.0, np.random.default_rng(0)))
    assert corrected.tip[1] == pytest.approx(needle.seen(after)[1], abs=1e-3)
    assert corrected.parameters[RUN_OUT] == pytest.approx(-0.15, abs=0.01)


def test_where_the_tip_was_is_on_the_side_of_the_bevel_then():
    """A turn is made as its move begins."""
    needle = NEEDLES["run-out"]
    estimate, states = followed(needle, 24)
    out = float(estimate.parameters[RUN_OUT])
    for time, flips in ((19.5, 0), (20.0, 0), (20.01, 1), (20.5, 1), (21.0, 1), (23.5, 1)):
        whole, part = int(time), time - int(time)
        axis = (1.0 - part) * estimate.tips[whole] + part * estimate.tips[min(24, whole + 1)]
        assert estimate.tip_at(time) == pytest.approx((axis[0], axis[1] + out * (-1) ** flips), abs=1e-9)
    assert estimate.tip_at(24.0) == pytest.approx(tuple(estimate.tip[:2]), abs=1e-12)
    assert states[-1].bevel == -1


@pytest.mark.parametrize("late", [1, 3])
def test_late_readings_lead_to_the_same_belief(late):
    """The fit takes all readings at once, so only the number of its steps so far differs."""
    needle = replace(NEEDLES["all"], variation=(1.0,))
    in_time, _ = followed(needle, 50)
    behind, states = followed(needle, 50, late=late)
    np.testing.assert_allclose(behind.tip[1:], in_time.tip[1:], atol=1e-3)
    assert behind.tip[1] == pytest.approx(needle.seen(states[-1])[1], abs=0.01)
    assert len(behind.moves) == 50


def test_the_belief_now_is_the_fitted_insertion_carried_out_again():
    """Bit for bit: base at the start, and each step with the needle and tissue that were learnt."""
    estimate, _ = followed(NEEDLES["all"], 45)
    states = stepped(estimate.parameters, commands(45))
    assert states[-1] == estimate.state
    np.testing.assert_array_equal(estimate.tips, [state.tip for state in states])
    now = Simulator(QUIET, 1).adapted(learnt_of(estimate.parameters))
    forward = Control(db_x=1.0)
    assert estimate.simulator.step(states[-1], forward) == now.step(states[-1], forward)


def test_innovation_and_measured_tip_are_those_of_the_newest_reading():
    needle = NEEDLES["run-out"]
    estimate, _ = followed(needle, 45)
    moved = estimate.move((1.0, 0.0, 0.0, 0.0, -1), 45.0, 46.0)
    x, y = np.add(moved.tip[:2], [0.01, 0.002])
    seen = moved.observe([Sample(46.0, float(x), float(y))])
    assert seen.measured == pytest.approx((x, y), abs=1e-9)
    assert seen.innovation[0] == pytest.approx(0.01, abs=2e-3)
    assert abs(seen.innovation[1]) < 0.002
    assert seen.tip_at(46.0) == pytest.approx(tuple(seen.tip[:2]), abs=1e-12)
    assert seen.unseen().innovation == (0.0, 0.0)


def test_in_air_nothing_is_left_over():
    estimate, _ = followed(Needle(base_y=0.3), 20, noise=0.05)
    assert estimate.residual == 0.0


def test_without_readings_or_moves_the_belief_stays():
    estimate, _ = followed(NEEDLES["bend"], 30)
    moved = estimate.move((1.0, 0.0, 0.0, 0.0, -1), 30.0, 31.0)
    for kept in (moved.observe([]), moved.unseen()):
        assert kept.state is moved.state
        assert kept.parameters is moved.parameters
        assert kept.innovation == (0.0, 0.0)
    start = Identification().begin(begun_with(Simulator(PHANTOM, 1), 1))
    assert start.observe([Sample(0.0, -28.5, 0.4)]).state == start.state


def test_observing_changes_nothing_of_the_old_belief_and_threads_nothing_of_the_new():
    needle = NEEDLES["all"]
    one, _ = followed(needle, 45, threads=1)
    many, _ = followed(needle, 45, threads=4)
    np.testing.assert_array_equal(one.parameters, many.parameters)
    assert one.state == many.state
    before = one.parameters.copy(), one.tips.copy(), one.state.scalars.copy(), one.moves
    moved = one.move((1.0, 0.0, 0.0, 0.1, -1), 45.0, 46.0)
    here, again = (moved.observe([Sample(46.0, 17.5, 1.0)]) for _ in range(2))
    np.testing.assert_array_equal(here.parameters, again.parameters)
    after = one.parameters, one.tips, one.state.scalars
    for kept, now in zip(before[:3], after, strict=True):
        np.testing.assert_array_equal(kept, now)
    assert one.moves is before[3]
