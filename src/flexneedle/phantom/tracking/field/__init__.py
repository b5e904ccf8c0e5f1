"""A simulated electromagnetic tracker in its field."""
