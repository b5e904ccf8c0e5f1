"""A rig without a tracker."""

from flexneedle.types import Measurement


class NoTracker:
    """A `TipTracker` that measures nothing."""

    status = "there is no tracker"

    def read(self) -> tuple[Measurement, ...]:
        """Return no reading."""
        return ()
