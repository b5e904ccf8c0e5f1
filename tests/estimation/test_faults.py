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
    """Against the densities with and without each fault, of three values at seven depths."""
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
            known.append((multivariate_normal.logpdf(left, cov=covariance + error) - plain, since))
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


def test_an_error_of_the_tracker_that_grows_is_the_tracker_s():
    """A slope that the start of the needle would explain, but not the curvatures."""
    estimate, _ = followed()
    moves = []
    for done, tip in zip(estimate.moves, estimate.tips[1:], strict=True):
        off = 0.1 * max(0.0, float(tip[0]))
        moves.append(
            replace(done, measurements=tuple(replace(one, y=one.y + off) for one in done.measurements))
        )
    found = find_faults(estimate.change(moves=tuple(moves)))
    assert max(found, key=lambda name: found[name].log_odds) == TRACKER


def test_what_the_tracker_alone_says_against_the_model_is_no_fault_of_it():
    estimate, _ = followed()
    alone = estimate.change(along=(), quantities=(), along_curves=())
    assert find_faults(alone)[TRACKER].log_odds <= 0.0
