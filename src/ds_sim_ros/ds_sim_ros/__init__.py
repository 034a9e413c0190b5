# SPDX-License-Identifier: Apache-2.0
"""Sibling `ros`: any ROS 2 simulator that a YAML file describes, driven through topics and services."""
