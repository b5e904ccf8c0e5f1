"""The page of `flexneedle serve`: plan, watch and replay in a browser."""
