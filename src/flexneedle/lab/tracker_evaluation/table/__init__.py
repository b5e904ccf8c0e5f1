"""Tables of measurements: read and grouped by DuckDB."""
