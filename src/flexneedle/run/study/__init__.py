"""Studies: many insertions of one scenario and its variations, carried out on many cores, kept in tables.

This module imports nothing, so that a worker process can set itself up before NumPy is loaded.
"""
