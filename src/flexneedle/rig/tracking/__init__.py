"""Simulated trackers, and the map from a tracker's frame to the stage's."""
