"""Files on disk: run folders, traces, tables."""
