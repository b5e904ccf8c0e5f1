"""Figures of evaluations and registrations, from arrays and names."""
