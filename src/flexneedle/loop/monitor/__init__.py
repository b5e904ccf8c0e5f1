"""The monitor of the tracker: its rules and its state."""
