"""Checks of a rig before an insertion: fit to a scenario, devices, speeds, and motions of the operator."""
