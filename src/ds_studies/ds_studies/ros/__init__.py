# SPDX-License-Identifier: Apache-2.0
"""The orchestrator as a ROS node."""
