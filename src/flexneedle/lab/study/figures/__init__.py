"""Figures of studies, drawn from panels of arrays and names."""
