"""Faults of sensors, found by the readings of all."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from flexneedle.estimation import faults
from flexneedle.estimation.faults import find_faults
from flexneedle.estimation.fitted import TRACKER
from sensed import followed


def test_the_odds_are_the_ratio_of_the_densities_of_the_readings():
    """Against the densities with and without each fault, of three values at seven depths; and the error now."""
    rng, size, depth = np.random.default_rng(2), 0.7, 30.0
    places, value = np.repeat(np.linspace(2.0, 29.0, 7), 3), np.tile(np.arange(3), 7)
    root = rng.normal(size=(21, 30))
    covariance, left = root @ root.T / 30.0, rng.normal(size=21)
    precision = np.linalg.inv(covariance)
    found = faults._find_fault(places, value, precision @ left, precision, size, depth)
    plain, known = multivariate_normal.logpdf(left, cov=covariance), []
    for since in (25.0, 20.0, 10.0, 0.0):
        way = np.maximum(0.0, places - since) / 40.0
        shapes = (np.minimum(way[:, None], way), way[:, None] * way)
        for shape in shapes:
            error = size**2 * shape * (value[:, None] == value)
            expected = error @ np.linalg.solve(covariance + error, left)
            odds = multivariate_normal.logpdf(left, cov=covariance + error) - plain
            known.append((odds, since, np.linalg.norm(expected[-3:])))
    assert found == pytest.approx(max(known))


def drifted(estimate, name, since, slope):
    """The estimate with an error of a sensor, in multiples of its noise, that grows from a depth on (1/mm)."""
    number = next(k for k, one in enumerate(estimate.along) if one.name == name)
    one = estimate.along[number]
    index, _, _ = estimate.timeline.at(one.time)
    gone = np.maximum(0.0, estimate.tips[index + 1, 0] - since)
    wrong = replace(one, value=one.value + slope * one.sensor.noise * gone[:, None])
    return estimate.change(along=tuple(wrong if one.name == name else one for one in estimate.along))


def test_healthy_sensors_have_no_fault():
    estimate, _ = followed()
    found = find_faults(estimate)
    assert found.keys() == {TRACKER, *(one.name for one in estimate.along)}
    assert max(one.log_odds for one in found.values()) < 3.0


def test_a_drift_is_found_with_its_sensor_and_its_onset():
    estimate, _ = followed()
    depth = float(estimate.tips[-1, 0])
    found = find_faults(drifted(estimate, "fbg", depth - 9.0, 0.6))
    name = max(found, key=lambda name: found[name].log_odds)
    assert name == "fbg"
    assert found[name].log_odds > 7.0
    assert found[name].log_odds > found[TRACKER].log_odds + 3.0
    assert depth - 20.0 <= found[name].since <= depth - 5.0


def moved(estimate, off):
    """The estimate with the tracker's y moved by a function of the depth."""
    moves = []
    for done, tip in zip(estimate.moves, estimate.tips[1:], strict=True):
        more = off(float(tip[0]))
        readings = tuple(replace(one, y=one.y + more) for one in done.measurements)
        moves.append(replace(done, measurements=readings))
    return estimate.change(moves=tuple(moves))


def test_an_error_of_the_tracker_that_grows_is_the_tracker_s():
    """A slope that the start of the needle would explain, but not the curvatures."""
    estimate, _ = followed()
    found = find_faults(moved(estimate, lambda x: 0.1 * max(0.0, x)))
    assert max(found, key=lambda name: found[name].log_odds) == TRACKER
    assert found[TRACKER].log_odds > 4.0


def test_the_evidence_of_the_tracker_alone_is_no_fault_of_it():
    estimate, _ = followed()
    depth = float(estimate.tips[-1, 0])
    alone = moved(estimate, lambda x: 1.0 * (x > depth - 4.0)).change(
        along=(), quantities=(), along_curves=()
    )
    assert find_faults(alone) == {}


def test_a_leap_that_the_tracker_shows_is_no_fault_of_another_sensor():
    """Without this the odds for the points are 7."""
    estimate, _ = followed()
    depth = float(estimate.tips[-1, 0])
    found = find_faults(moved(estimate, lambda x: 0.8 * (x > depth - 4.0)))
    assert max(found[one.name].log_odds for one in estimate.along) < 1.0


def test_readings_since_which_no_other_sensor_measured_are_no_evidence():
    """Beside the others the odds for the fibre are 486."""
    estimate, _ = followed()
    last = estimate.moves[-2].motion.begun
    wrong = drifted(estimate, "fbg", float(estimate.tips[-3, 0]), 30.0)
    moves = (*wrong.moves[:-2], *(replace(one, measurements=()) for one in wrong.moves[-2:]))
    along = tuple(one if one.name == "fbg" else one.without(last) for one in wrong.along)
    assert find_faults(wrong)["fbg"].log_odds > 100.0
    assert find_faults(wrong.change(moves=moves, along=along))["fbg"].log_odds < 1.0


def test_the_odds_are_those_of_the_readings_whatever_the_fit_took_for_an_offset():
    estimate, _ = followed()
    offset = estimate.along[0].slots.offset
    other = estimate.parameters.copy()
    other[offset] += 2.0 * estimate.along[0].sensor.offset_sd
    known, found = find_faults(estimate), find_faults(estimate.simulate_with(other))
    for name, one in known.items():
        assert found[name].log_odds == pytest.approx(one.log_odds, abs=0.02)


def test_what_a_declared_field_explains_is_no_fault():
    estimate, _ = followed()
    grown = moved(estimate, lambda x: 0.1 * max(0.0, x))
    declared = find_faults(grown.with_field(2.0, 0.0))[TRACKER]
    assert declared.log_odds < 1.0 < 4.0 < find_faults(grown)[TRACKER].log_odds


def test_what_the_error_of_the_model_explains_is_no_fault(monkeypatch):
    estimate, _ = followed()
    wrong = drifted(estimate, "fbg", float(estimate.tips[-1, 0]) - 9.0, 0.3)
    known = find_faults(wrong)["fbg"].log_odds
    kind = type(wrong.along[0].sensor)
    plain = kind.model_error
    monkeypatch.setattr(kind, "model_error", lambda sensor, values: 10.0 * plain(sensor, values))
    assert find_faults(wrong)["fbg"].log_odds < 0.3 * known
