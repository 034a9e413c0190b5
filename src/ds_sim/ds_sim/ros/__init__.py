"""The ROS side of every simulator: one node that hosts any of them."""
