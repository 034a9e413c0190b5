# SPDX-License-Identifier: Apache-2.0
"""The orchestrator's ROS side: processes, domains, and the client that drives roads on them."""
