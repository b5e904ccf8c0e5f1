"""Closed-loop control of an insertion (paper section III-B): one file in `controllers` for each controller."""
