"""Run folders: plan and insert with a record on disk, read and draw it."""
