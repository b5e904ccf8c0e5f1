"""The rig: ports, closed loop, monitor, virtual rigs, devices and their emulators."""
