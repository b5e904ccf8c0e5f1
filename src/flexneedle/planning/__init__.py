"""The cross-entropy method, the terms of a cost, and plans made with both. Knows arrays and a rollout, no needle."""

from flexneedle.planning.cross_entropy import Belief, Search, Settings, ask, minimize, tell
from flexneedle.planning.horizon import Found, Variables, best
from flexneedle.planning.insertion import Problem, Solution, optimise
from flexneedle.planning.steering import reach, steer
from flexneedle.planning.terms import Outcome, Term

__all__ = [
    "Belief",
    "Found",
    "Outcome",
    "Problem",
    "Search",
    "Settings",
    "Solution",
    "Term",
    "Variables",
    "ask",
    "best",
    "minimize",
    "optimise",
    "reach",
    "steer",
    "tell",
]
