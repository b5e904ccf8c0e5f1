"""The cross-entropy method, the terms of a cost, and insertion plans found with both."""
