"""NDI Aurora, behind the port `Tracker`."""
