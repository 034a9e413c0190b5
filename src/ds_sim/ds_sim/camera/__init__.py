# SPDX-License-Identifier: Apache-2.0
"""Pinhole or wide-angle camera over a painted ground plane, without ROS."""
