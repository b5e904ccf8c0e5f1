"""ROS 2 over DDS, without a ROS installation: a node of its own process, and a rig of topics."""
