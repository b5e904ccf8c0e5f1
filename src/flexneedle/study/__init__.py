"""Studies: many insertions by a grid of conditions, and their report."""
