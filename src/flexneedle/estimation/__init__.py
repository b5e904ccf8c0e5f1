"""Observers: the estimated needle, corrected by delayed readings."""
