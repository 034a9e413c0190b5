"""The ROS side: a node that drives another simulator."""
