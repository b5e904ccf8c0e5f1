"""What a run leaves behind: plain records, and their file on disk."""

from flexneedle.trace.records import Insertion, Judged, Period, PlanRecord

__all__ = ["Insertion", "Judged", "Period", "PlanRecord"]
