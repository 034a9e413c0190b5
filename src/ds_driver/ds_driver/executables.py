# SPDX-License-Identifier: Apache-2.0
"""Entry points of this package's nodes; a signal ends them at once, also during their imports."""

from functools import partial

from ds_base.executables import start

driver = partial(start, "ds_driver.ros.driver_node")
"""Runs a network that drives simulators."""
autopilot = partial(start, "ds_driver.ros.autopilot_node")
"""Runs the reference driver."""
closed_loop = partial(start, "ds_driver.ros.closed_loop_node")
"""Runs a simulator together with its driver."""
camera_driver = partial(start, "ds_driver.ros.camera_driver_node")
"""Runs a network on another ROS stack."""
cmd_vel_adapter = partial(start, "ds_driver.ros.cmd_vel_adapter_node")
"""Runs the adapter for drivers that know only standard messages."""
