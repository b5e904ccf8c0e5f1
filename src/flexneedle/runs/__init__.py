"""Run folders: plan and insert with a record on disk, and draw it again."""
