"""Observers: the estimated needle, corrected by readings that come late."""
