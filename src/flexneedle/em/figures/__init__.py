"""Figures of evaluations and registrations. They take arrays and names."""
