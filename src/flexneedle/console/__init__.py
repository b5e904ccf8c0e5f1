"""Shared by commands: arguments, progress, tables and JSON on stdout."""
