"""The tip tracker: a simulated one, and the judgement of readings before anything believes them."""

from flexneedle.tracking.judgement import OK, judge
from flexneedle.tracking.simulated import NoisyTracker

__all__ = ["OK", "NoisyTracker", "judge"]
