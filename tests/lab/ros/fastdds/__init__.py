"""A ROS node with eProsima's DDS in place of Cyclone."""
