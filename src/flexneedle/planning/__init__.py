"""The cross-entropy method, and insertion plans made with it. Knows arrays and a rollout function, no needle."""

from flexneedle.planning.cross_entropy import Belief, Settings, ask, minimize, tell
from flexneedle.planning.insertion import Problem, Solution, optimise

__all__ = ["Belief", "Problem", "Settings", "Solution", "ask", "minimize", "optimise", "tell"]
