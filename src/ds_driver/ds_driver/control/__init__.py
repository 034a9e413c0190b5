"""Controllers without ROS: autopilot, speed control, conversions of driving commands."""
