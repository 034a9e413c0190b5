"""ROS nodes of the drivers."""
