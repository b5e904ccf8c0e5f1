"""Figures of evaluations, from arrays and names."""
