"""The orchestrator as a ROS node."""
