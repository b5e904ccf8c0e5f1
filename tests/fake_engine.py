"""Planner and closed loop that are made up: quick, and as slow, wrong or interrupted as a test wants them."""

import os
import signal
import sys
from dataclasses import replace
from functools import partial

import numpy as np

from flexneedle.control.controllers import CONTROLLERS
from flexneedle.errors import RunError
from flexneedle.types import Insertion, Outcome
from synthetic import make_periods, make_plan


def plan(scenario, target=None, strategy="manipulation", seed=0, progress=None, *, miss=0.0):
    """Plan as `flexneedle.plan` does; `miss` displaces the end of the plan."""
    made = make_plan(strategy, target or scenario.target.position, seed)
    for iteration in range(1, 6):
        progress({"iteration": iteration, "iterations": 5, "best": 9.0, "cost_mean": 9.0})
    limit = "setup.max_guide_travel_mm = 15" if miss > 1.0 else ""
    return replace(made, tips=made.tips + np.array([0.0, miss, 0.0, 0.0, 0.0]), limit=limit)


def insert(
    _scenario,
    plan,
    seed=0,
    *,
    controller="adaptive-mpc",
    phantom="exact",
    tracker="scenario",
    force=False,
    on_period=None,
    miss=0.06,
    stop=None,
    outcome="done",
    **_of_a_rig,
):
    """Insert as `flexneedle.insert` does; stop: after so many periods, call that."""
    del tracker  # nothing is measured
    if not (plan.reached or force or CONTROLLERS[controller].predicts):
        raise RunError(f"plan misses the target by {plan.error_mm:.2f} mm, limited by {plan.limit}")
    periods = []
    for period in make_periods(plan, miss, seed):
        periods.append(period)
        on_period(period)
        if stop is not None and len(periods) == stop[0]:
            stop[1]()
    reason = "" if outcome == "done" else "no sample for 1.00 s"
    return Insertion(plan, seed, tuple(periods), Outcome(outcome), reason, controller, phantom)


def install(setattr_, **options):
    """Put both in the place of the real ones by `setattr_`; options change their defaults."""
    from flexneedle.loop import insert as insertion
    from flexneedle.planning import planner

    plan_options = {"miss": options.pop("plan_miss", 0.0)}
    setattr_(planner, "plan", partial(plan, **plan_options))
    setattr_(insertion, "insert", partial(insert, **options))


def draw_nothing(setattr_):
    """Put empty figures in the place of those of plans and insertions: drawing takes most of a command's time."""
    from flexneedle.figures.style import new_figure
    from flexneedle.record import figures

    for name in ("insertion_figure", "plan_figure"):
        setattr_(figures, name, lambda *_: new_figure(1.0))


def main():
    """Run the command line after a first argument: the signal (name) that hits in the 12th period."""
    from flexneedle.cli.main import main as flexneedle

    number = signal.Signals[sys.argv[1]]
    draw_nothing(setattr)
    install(setattr, stop=(12, partial(os.kill, os.getpid(), number)))
    sys.exit(flexneedle(sys.argv[2:]))


if __name__ == "__main__":
    main()
