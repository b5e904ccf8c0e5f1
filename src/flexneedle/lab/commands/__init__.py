"""Commands of the laboratory, and its options of `insert` and `view`: entry points of `flexneedle.commands`."""
