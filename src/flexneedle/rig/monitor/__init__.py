"""The monitor of the tracker: rules, and what it remembers of past readings."""
