# SPDX-License-Identifier: Apache-2.0
"""Records images from a live ROS graph, and publishes bags to it."""
