"""Fibre Bragg gratings along the needle: FBGS ShapeCore and interrogators of wavelengths."""
