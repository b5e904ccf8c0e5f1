"""ROS 2 over DDS without a ROS installation: the node of an insertion, and motors and trackers on topics."""
