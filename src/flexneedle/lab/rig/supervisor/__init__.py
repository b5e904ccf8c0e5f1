"""The process that owns the devices of a rig: it ticks, checks, sends targets, and stops."""
