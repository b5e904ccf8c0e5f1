"""Scenarios: which needle is inserted into which tissue, towards which target, with which settings."""
