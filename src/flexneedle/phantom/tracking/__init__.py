"""Simulated trackers and registration of a tracker's frame to the stage's."""
