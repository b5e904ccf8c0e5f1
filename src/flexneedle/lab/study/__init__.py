"""Studies: many insertions over a grid of conditions, and their report."""
