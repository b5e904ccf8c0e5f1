"""The tracker: simulated ones, what may be believed of one, its registration, its evaluation."""

from flexneedle.tracking.monitor import Watch
from flexneedle.tracking.rules import OK
from flexneedle.tracking.simulated import NoisyTracker

__all__ = ["OK", "NoisyTracker", "Watch"]
