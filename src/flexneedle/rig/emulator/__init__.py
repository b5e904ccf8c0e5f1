"""Emulators of devices, on their own protocols."""
