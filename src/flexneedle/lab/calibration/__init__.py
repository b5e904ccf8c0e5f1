"""Recorded insertions: import, calibration of a scenario, validation."""
