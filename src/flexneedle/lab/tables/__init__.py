"""Reader of tables with one row per sample of a tracker: recordings, measurements, pairs of points."""
