# SPDX-License-Identifier: Apache-2.0
"""The ROS side: a node that drives another simulator."""
