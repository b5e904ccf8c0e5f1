"""NDI Aurora with the port `Tracker`."""
