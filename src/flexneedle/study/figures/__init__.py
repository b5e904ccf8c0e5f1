"""Figures of studies. They take panels of arrays and names."""
