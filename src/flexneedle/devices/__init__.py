"""Real trackers behind the port `Tracker`, and the emulators to try them without."""
