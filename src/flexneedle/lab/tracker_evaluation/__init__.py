"""Evaluating electromagnetic trackers, fitting registrations, recording grids. No other room imports it."""
