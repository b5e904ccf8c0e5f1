"""Services and views of a flexneedle rig for ROS 2."""
