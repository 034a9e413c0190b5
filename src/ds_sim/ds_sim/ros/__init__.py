# SPDX-License-Identifier: Apache-2.0
"""The ROS side of every simulator: one node that hosts any of them."""
