"""What `flexneedle em` does: tracker data in, results, tables and figures out."""
