"""The sections of a scenario file, a model each."""
