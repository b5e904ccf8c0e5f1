"""Whole tasks: plan an insertion, carry it out, keep and redraw its record."""
