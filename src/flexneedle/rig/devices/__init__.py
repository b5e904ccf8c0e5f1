"""Devices behind the ports of a rig."""
