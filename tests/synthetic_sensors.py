"""Synthetic readings of sensors along the needle."""

import math
from dataclasses import replace

from flexneedle.record.fields import parse_verdict
from flexneedle.types import OK, CheckedReading, Reading, SensorState
from synthetic import make_insertion

FROZEN = "frozen: 20 identical readings while the tip travelled 1.2 mm"
COVARIANCE = ((1e-4, 8e-5, 0.0), (8e-5, 4e-4, 1 / 3e4), (0.0, 1 / 3e4, 9e-4))
EXCLUDED_FROM = 30  # the period from which the fibre is excluded


def with_sensors(insertion=None):
    """Return an insertion with curvatures of two sites, and a crossing of a plane that the needle reaches later."""
    insertion = insertion or make_insertion()
    return replace(insertion, periods=tuple(map(_with_sensors, insertion.periods)))


def _with_sensors(period):
    k, tip = period.index, period.true_tip
    verdict = parse_verdict(FROZEN) if k >= EXCLUDED_FROM else OK
    bent = Reading(period.time - 0.02, ((1e-3 / (k + 1), -0.0), (math.nan, 1 / 3e3)))
    fibre = SensorState("fbg", (CheckedReading(bent, OK),), verdict, 0.1 * (k + 1) / 3)
    missed = CheckedReading(Reading(period.time - 0.1, (), "no needle"), parse_verdict("missing: no needle"))
    seen = CheckedReading(Reading(period.time - 0.1, ((20.0, tip.y + 0.1, 0.0),)), OK)
    image = SensorState("slice", (seen if tip.x > 20.0 else missed,), nis=0.8 if tip.x > 20.0 else math.nan)
    return replace(period, sensors=(fibre, image), tip_covariance=COVARIANCE)
