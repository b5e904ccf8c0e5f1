"""Devices with the ports of a rig."""
