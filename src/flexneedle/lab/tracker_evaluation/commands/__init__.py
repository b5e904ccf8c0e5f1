"""Commands of `flexneedle em`: parse arguments, call the library, print."""
