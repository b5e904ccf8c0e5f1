"""The rig: its ports, the closed loop on it, the monitor, virtual rigs, devices and their emulators."""
