"""The findings on a study: its rows, read and checked, and their statistics."""
