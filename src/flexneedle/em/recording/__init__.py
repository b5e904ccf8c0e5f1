"""Recording a tracker on a grid of points, and watching one."""
