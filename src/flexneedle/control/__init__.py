"""Closed-loop control of an insertion (paper section III-B): observe, decide, turn the bevel."""
