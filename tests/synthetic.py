"""A synthetic plan and insertion: plausible, quick, and the same on every machine."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from flexneedle import controls as controls_of
from flexneedle.results import Action, Insertion, Outcome, Period, Plan
from flexneedle.types import DG_Y, ROLL, THETA, Control, Measurement, Pose, Verdict, VerdictKind, X, Y

START, LENGTH, GUIDE_X, STEP = -28.5, 150.0, -41.0, 1.0
TURN_AT = 45  # the step that turns the bevel


def tip_path(depth, target=(40.0, 5.0), entry=-2.0):
    """Return poses (m, 5) of the tip at depths (m,): from the axis over `entry` at the skin to the target."""
    known = (START, -18.0, 0.0, target[0] / 2, target[0])
    curve = np.polynomial.Polynomial.fit(known, (0.0, 0.1 * entry, entry, 0.2 * entry, target[1]), 4)
    return _poses(depth, curve)


def needle_shape(path, base, guide, nodes=61):
    """Return nodes (n, 5) from the base over the guide along the path of the tip (m, 5) to its last pose."""
    tip = path[-1]
    x = np.linspace(base, tip[0], nodes)
    known_x = np.concatenate([[base], [GUIDE_X], path[path[:, 0] > -5.0, 0] if tip[0] > 0 else [tip[0]]])
    known_y = np.concatenate([[0.0], [guide], path[path[:, 0] > -5.0, 1] if tip[0] > 0 else [tip[1]]])
    smooth = np.polynomial.Polynomial.fit(known_x, known_y, min(5, len(known_x) - 1))
    return _poses(x, smooth)


def _poses(x, curve):
    """Return poses (n, 5) along a curve y(x)."""
    rows = np.zeros((len(x), 5))
    rows[:, X], rows[:, Y], rows[:, THETA] = x, curve(x), np.arctan(curve.deriv()(x))
    return rows


def make_plan(strategy="manipulation", target=(40.0, 5.0), seed=0, step=STEP):
    """Return a plan that meets its target to 0.01 mm, in steps of `step` mm."""
    depth = np.append(np.arange(START, target[0], step), target[0])
    entry = -2.0 if strategy == "manipulation" else 0.3
    tips = tip_path(depth, (target[0], target[1] + 0.01), entry)
    guide = (-3.0 if strategy == "manipulation" else 0.0) * np.sin(np.linspace(0.0, 2.4, len(depth)))
    inside = np.clip(depth, 0.0, None) / target[0]
    energy = (0.8 if strategy == "manipulation" else 2.1) * inside**2
    controls = controls_of(len(depth) - 1, db_x=np.diff(depth), dg_y=np.diff(guide))
    controls[round(TURN_AT / step), ROLL] = np.pi
    shapes = np.stack(
        [
            needle_shape(tips[: k + 1], d - LENGTH, g)
            for k, (d, g) in enumerate(zip(depth, guide, strict=True))
        ]
    )
    terms = {"accuracy": 0.2, "energy": 5 * energy[-1], "deflection": 1.9, "control": 1.2, "rolls": 0.3}
    history = tuple({"iteration": k, "best": 9.0 / k, "quantile": 10.0 / k} for k in range(1, 13))
    return Plan(
        strategy, (*target, 0.0)[:3], seed, 0.0, controls, tips, energy, np.column_stack([guide, 0.0 * guide]), shapes,
        sum(terms.values()), terms,
        12, True, history, "", 0.71, least_stretch=1.0 - 0.1 * inside,
        clearance=np.where(depth > 0.0, 4.0 - inside, np.inf),
    )  # fmt: skip


def make_periods(plan, miss=0.06, seed=0):
    """Yield a period for each step of the plan; the true tip ends `miss` mm beyond the target, laterally."""
    rng = np.random.default_rng(seed)
    roll, step = plan.roll, plan.tips[1, X] - plan.tips[0, X]
    flips = [round((TURN_AT + off) / step) for off in (-4, 8, 20)]
    for k, (before, tip) in enumerate(pairwise(plan.tips)):
        inside = max(0.0, tip[0]) / plan.target[0]
        off = 0.5 * np.cos(3 * inside) * (1 - inside) + miss * inside
        flip = k in flips
        roll = np.pi - roll if flip else roll
        x, y, _, theta, _ = tip.tolist()
        true = Pose(x, y + off, 0.0, theta + 0.002, 0.0)
        noise = rng.normal(0.0, 0.04, 2)
        estimate = Pose(x, y + off + 0.5 * noise[0], 0.0, theta, 0.0)
        command = Control(db_x=x - before[0], dg_y=plan.controls[k, DG_Y] + 0.01, flip=flip)
        yield Period(
            index=k, time=0.2 * (k + 1), command=command,
            applied=command._replace(dg_y=round(command.dg_y, 2)),
            measurement=Measurement(0.2 * (k + 1) - 0.025, true.x + noise[0], true.y + noise[1]),
            verdict=Verdict(), innovation=(noise[0], noise[1], 0.0), estimate=estimate,
            shape=plan.shapes[k + 1] + [0.0, off, 0.0, 0.0, 0.0], base=Pose(x - LENGTH, 0.0, 0.0, 0.0, 0.0),
            guide=(plan.guide[k + 1, 0] + 0.3 * np.sin(0.2 * k), 0.0), roll=roll,
            strain_energy=plan.strain_energy[k + 1] * 1.1, tip_load=(0.01 * off, 0.0),
            path=Pose.of(tip), cost=1.5 - inside, spread=0.05,
            action=Action.MOVE, decision="turn" if flip else "nearer path",
            true_tip=true, true_strain_energy=plan.strain_energy[k + 1] * 1.25,
            true_stretch=float(1.0 - 0.17 * inside**2),
            clearance=3.9 - inside, true_clearance=3.8 - inside,
            true_shape=plan.shapes[k + 1, :, :3] + [0.0, off, 0.0], energy_scale=0.04,
            durations={"observe": 0.001, "decide": 0.004, "total": 0.0051 + 1e-5 * k},
        )  # fmt: skip


def make_insertion(plan=None, miss=0.06, seed=0, outcome="done", reason="", periods=None):
    """Return an insertion along the plan; `periods`: number of periods to keep (default: all)."""
    plan = plan or make_plan(seed=seed)
    return Insertion(plan, seed, tuple(make_periods(plan, miss, seed))[:periods], Outcome(outcome), reason)


def blind(period):
    """Return the period without a measurement and without a true state."""
    measurement = Measurement(period.measurement.time, None, None)
    return replace(
        period,
        measurement=measurement,
        verdict=Verdict(VerdictKind.MISSING),
        innovation=(0.0, 0.0, 0.0),
        true_tip=None,
        true_strain_energy=None,
        true_stretch=None,
        true_clearance=None,
        true_shape=None,
    )
