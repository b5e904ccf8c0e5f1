"""Sensors along the needle: a kind is a file here with a subclass of `Sensor`."""
