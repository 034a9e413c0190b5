"""Verbs of `ds` as ROS executables."""
