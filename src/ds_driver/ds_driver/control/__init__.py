# SPDX-License-Identifier: Apache-2.0
"""Controllers without ROS: autopilot, speed control, conversions of driving commands."""
