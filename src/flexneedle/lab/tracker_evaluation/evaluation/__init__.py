"""Evaluation of a tracker from a table of repeated measurements."""
