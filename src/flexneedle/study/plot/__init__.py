"""Figures of studies. They take arrays and names."""
