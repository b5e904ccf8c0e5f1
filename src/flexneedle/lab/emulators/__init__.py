"""Emulators of devices with their native protocols."""
