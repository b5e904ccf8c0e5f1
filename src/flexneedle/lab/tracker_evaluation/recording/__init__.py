"""Recording a tracker at the points of a grid, and watching its live readings."""
