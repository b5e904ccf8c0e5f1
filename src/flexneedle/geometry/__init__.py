"""Rotations and rigid registrations."""
