"""Pinhole or wide-angle camera over a painted ground plane, without ROS."""
