"""Emulated devices on pseudo-terminals, each a process of its own: try and test the real thing without it."""
