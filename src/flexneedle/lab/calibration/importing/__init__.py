"""Import of recorded insertions: tables, a map of their columns, steps, frames."""
