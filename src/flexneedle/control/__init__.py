"""Closed-loop control of an insertion (paper section III-B): a controller a file in `methods`."""
