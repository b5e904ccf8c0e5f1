"""The cross-entropy method, the terms of a cost, and plans made with both."""
