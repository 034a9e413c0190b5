"""Drives networks in simulation, in this process and without ROS."""
