"""Figures of plans and insertions (matplotlib, Agg): same data, same bytes."""
