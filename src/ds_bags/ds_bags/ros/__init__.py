"""Records images from a live ROS graph, and publishes bags to it."""
