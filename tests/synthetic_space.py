"""A synthetic plan and insertion in space: the ones in the plane, turned about the insertion axis."""

import cmath
from dataclasses import replace

import numpy as np

from flexneedle.types import DB_Y, DG_Y, THETA, Pose, Shape, X, Y


def turned_rows(rows, angle, *pairs):
    """Return rows (…, k) with the pairs of columns, of which the first is given, turned by an angle (rad)."""
    found = np.array(rows, dtype=float)
    for first in pairs or (Y, THETA):
        value = (found[..., first] + 1j * found[..., first + 1]) * cmath.exp(1j * angle)
        found[..., first], found[..., first + 1] = value.real, value.imag
    return found


def turned_plan(plan, angle):
    """Return a plan turned by an angle (rad)."""
    return replace(
        plan,
        target=tuple(turned_rows(plan.target, angle, Y).tolist()),
        roll=plan.roll + angle,
        controls=turned_rows(plan.controls, angle, DB_Y, DG_Y),
        tips=turned_rows(plan.tips, angle),
        guide=turned_rows(plan.guide, angle, 0),
        shapes=turned_rows(plan.shapes, angle),
    )


def turned_period(period, angle):
    """Return a period turned by an angle (rad), with a predicted shape: sd of 0.2 mm in y and 0.4 mm in z."""
    measured = period.measurement
    if measured.y is not None:
        place = turned_rows((measured.x, measured.y, 0.0), angle, Y).tolist()
        measured = replace(measured, y=place[1], z=place[2])
    shape = turned_rows(period.shape, angle)
    return replace(
        period,
        measurement=measured,
        estimate=turned_pose(period.estimate, angle),
        base=turned_pose(period.base, angle),
        path=turned_pose(period.path, angle),
        true_tip=None if period.true_tip is None else turned_pose(period.true_tip, angle),
        guide=tuple(turned_rows(period.guide, angle, 0).tolist()),
        roll=period.roll + angle,
        shape=shape,
        predicted=Shape(shape + 10.0 * np.eye(5)[X], np.tile([0.2, 0.4], (len(shape), 1))),
    )


def turned_pose(pose, angle):
    """Return a pose turned by an angle (rad)."""
    return Pose.of(turned_rows(pose, angle))


def in_space(insertion, angle):
    """Return an insertion in the plane turned by an angle (rad) about the axis."""
    periods = tuple(turned_period(period, angle) for period in insertion.periods)
    return replace(insertion, plan=turned_plan(insertion.plan, angle), periods=periods)
