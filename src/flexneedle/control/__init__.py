"""Closed-loop control of an insertion (paper section III-B): one file in `methods` for each controller."""
