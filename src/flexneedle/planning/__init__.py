"""Insertion plans, found with the cross-entropy method."""
