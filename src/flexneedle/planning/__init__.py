"""Insertion plans, found with the cross-entropy method."""

STRATEGIES = ("manipulation", "steering")
"""Strategies of plans, which move guide and bevel or only the bevel; the default first."""
