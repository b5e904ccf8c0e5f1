"""A plan and an insertion made up by hand: plausible to look at, quick to make, the same on every machine."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from flexneedle.types import Action, Insertion, Measurement, Outcome, Period, Plan, Verdict, VerdictKind

START, LENGTH, GUIDE_X, STEP = -28.5, 150.0, -41.0, 1.0
TURN_AT = 45  # the step that turns the bevel


def tip_path(depth, target=(40.0, 5.0), entry=-2.0):
    """Poses (m, 3) of the tip at depths (m,): from the axis over `entry` at the skin to the target."""
    known = (START, -18.0, 0.0, target[0] / 2, target[0])
    curve = np.polynomial.Polynomial.fit(known, (0.0, 0.1 * entry, entry, 0.2 * entry, target[1]), 4)
    return np.column_stack([depth, curve(depth), np.arctan(curve.deriv()(depth))])


def needle_shape(path, base, guide, nodes=61):
    """Nodes (n, 3) from the base over the guide along the path of the tip (m, 3) to its last pose."""
    tip = path[-1]
    x = np.linspace(base, tip[0], nodes)
    known_x = np.concatenate([[base], [GUIDE_X], path[path[:, 0] > -5.0, 0] if tip[0] > 0 else [tip[0]]])
    known_y = np.concatenate([[0.0], [guide], path[path[:, 0] > -5.0, 1] if tip[0] > 0 else [tip[1]]])
    smooth = np.polynomial.Polynomial.fit(known_x, known_y, min(5, len(known_x) - 1))
    y = smooth(x)
    return np.column_stack([x, y, np.arctan(smooth.deriv()(x))])


def make_plan(strategy="manipulation", target=(40.0, 5.0), seed=0):
    """Return a plan that meets its target to 0.01 mm."""
    depth = np.append(np.arange(START, target[0], STEP), target[0])
    entry = -2.0 if strategy == "manipulation" else 0.3
    tips = tip_path(depth, (target[0], target[1] + 0.01), entry)
    guide = (-3.0 if strategy == "manipulation" else 0.0) * np.sin(np.linspace(0.0, 2.4, len(depth)))
    inside = np.clip(depth, 0.0, None) / target[0]
    energy = (0.8 if strategy == "manipulation" else 2.1) * inside**2
    controls = np.zeros((len(depth) - 1, 5))
    controls[:, 0], controls[:, 3], controls[:, 4] = np.diff(depth), np.diff(guide), -1.0
    controls[TURN_AT, 4] = 1.0
    shapes = np.stack(
        [
            needle_shape(tips[: k + 1], d - LENGTH, g)
            for k, (d, g) in enumerate(zip(depth, guide, strict=True))
        ]
    )
    terms = {"accuracy": 0.2, "energy": 5 * energy[-1], "deflection": 1.9, "control": 1.2, "flips": 0.3}
    history = tuple({"iteration": k, "best": 9.0 / k, "quantile": 10.0 / k} for k in range(1, 13))
    return Plan(
        strategy, target, seed, 1, controls, tips, energy, guide, shapes, sum(terms.values()), terms,
        12, True, history, "", 0.71,
    )  # fmt: skip


def make_periods(plan, miss=0.06, seed=0):
    """Yield a period for each step of the plan; the true tip ends `miss` mm beyond the target, laterally."""
    rng = np.random.default_rng(seed)
    side = plan.bevel
    for k, (before, tip) in enumerate(pairwise(plan.tips)):
        inside = max(0.0, tip[0]) / plan.target[0]
        off = 0.5 * np.cos(3 * inside) * (1 - inside) + miss * inside
        flip = 1 if k in (TURN_AT - 4, TURN_AT + 8, TURN_AT + 20) else -1
        side = -side if flip > 0 else side
        true = (tip[0], tip[1] + off, tip[2] + 0.002)
        noise = rng.normal(0.0, 0.04, 2)
        estimate = (tip[0], tip[1] + off + 0.5 * noise[0], tip[2])
        command = (tip[0] - before[0], 0.0, 0.0, plan.controls[k, 3] + 0.01, flip)
        yield Period(
            index=k, time=0.2 * (k + 1), command=command,
            applied=(command[0], 0.0, 0.0, round(command[3], 2), flip),
            measurement=Measurement(0.2 * (k + 1) - 0.025, true[0] + noise[0], true[1] + noise[1]),
            verdict=Verdict(), innovation=(noise[0], noise[1]), estimate=estimate,
            shape=plan.shapes[k + 1] + [0.0, off, 0.0], base=(tip[0] - LENGTH, 0.0, 0.0),
            guide=plan.guide[k + 1] + 0.3 * np.sin(0.2 * k), bevel=side,
            strain_energy=plan.strain_energy[k + 1] * 1.1, tip_load=0.01 * off,
            path=tuple(tip), cost=1.5 - inside, spread=0.05,
            action=Action.MOVE, decision="nearer path" if flip < 0 else "turn",
            true_tip=true, true_strain_energy=plan.strain_energy[k + 1] * 1.25,
            true_stretch=float(1.0 - 0.17 * inside**2),
            durations={"observe": 0.001, "decide": 0.004, "total": 0.0051 + 1e-5 * k},
        )  # fmt: skip


def make_insertion(plan=None, miss=0.06, seed=0, outcome="done", reason="", periods=None):
    """Return an insertion along the plan; `periods` keeps only so many."""
    plan = plan or make_plan(seed=seed)
    return Insertion(plan, seed, tuple(make_periods(plan, miss, seed))[:periods], Outcome(outcome), reason)


def blind(period):
    """Return the period as it is when the tracker saw nothing and there is no phantom to ask."""
    measurement = Measurement(period.measurement.time, None, None)
    return replace(
        period,
        measurement=measurement,
        verdict=Verdict(VerdictKind.MISSING),
        innovation=(0.0, 0.0),
        true_tip=None,
        true_strain_energy=None,
        true_stretch=None,
    )
