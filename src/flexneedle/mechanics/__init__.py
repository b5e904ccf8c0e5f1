"""Mechanics of a flexible needle in layered soft tissue: constants, laws, equilibrium, insertion steps.

Only this layer knows the compute library; everything here works on plain arrays.
"""
