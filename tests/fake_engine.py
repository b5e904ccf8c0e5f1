"""Planner and closed loop that are made up: quick, and as slow, wrong or interrupted as a test wants them."""

import os
import signal
import sys
from dataclasses import replace
from functools import partial

import numpy as np

from flexneedle.errors import RunError
from flexneedle.loop.events import PeriodEnded
from flexneedle.planning.events import Iterated, send_event
from flexneedle.results import Insertion, Outcome
from synthetic import make_periods, make_plan


def plan(scenario, target=None, strategy="manipulation", seed=0, *, listeners=(), miss=0.0):
    """Plan as `flexneedle.plan` does; `miss` displaces the end of the plan."""
    made = make_plan(strategy, target or scenario.target.position, seed, step=3.0)
    for iteration in range(1, 6):
        send_event(Iterated(strategy, {"iteration": iteration, "iterations": 5, "best": 9.0}), listeners)
    limit = "setup.max_guide_travel_mm = 15" if miss > 1.0 else ""
    return replace(made, tips=made.tips + np.array([0.0, miss, 0.0, 0.0, 0.0]), limit=limit)


def carry_out(_scenario, plan, choices, stream, *, miss=0.06, stop=None, outcome="done"):
    """Insert as `flexneedle.loop.insertions.carry_out` does; stop: number of periods, and a function to call then."""
    if not (plan.reached or choices.force or choices.controller.predicts):
        raise RunError(f"plan misses the target by {plan.error_mm:.2f} mm, limited by {plan.limit}")
    periods = []
    for period in make_periods(plan, miss, choices.seed):
        periods.append(period)
        stream.send(PeriodEnded(period))
        if stop is not None and len(periods) == stop[0]:
            stop[1]()
    reason = "" if outcome == "done" else "no sample for 1.00 s"
    ended = Insertion(plan, choices.seed, tuple(periods), Outcome(outcome), reason)
    return replace(ended, **choices.parts)


def install(setattr_, **options):
    """Put both in the place of the real ones by `setattr_`; options change their defaults."""
    from flexneedle.record import plans, recording

    setattr_(plans, "make_plan", partial(plan, miss=options.pop("plan_miss", 0.0)))
    setattr_(recording, "carry_out", partial(carry_out, **options))


def draw_nothing(setattr_):
    """Replace the figures of plans and insertions by empty ones: drawing takes most of a command's time."""
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
