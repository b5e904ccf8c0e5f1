"""Commands of `flexneedle em`: read arguments, call, print."""
