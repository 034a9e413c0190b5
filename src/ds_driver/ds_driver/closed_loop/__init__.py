# SPDX-License-Identifier: Apache-2.0
"""Drives networks in simulation, in this process and without ROS."""
