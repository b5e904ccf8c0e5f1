"""Figures of plans and insertions, as pure functions of records."""
