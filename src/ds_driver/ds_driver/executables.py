"""Entry points of this package's nodes; a signal ends them at once, also during their imports."""

from __future__ import annotations

from ds_sim.executables import start


def driver() -> None:
    """Run a network that drives simulators."""
    start("ds_driver.ros.driver_node")


def autopilot() -> None:
    """Run the reference driver."""
    start("ds_driver.ros.autopilot_node")


def closed_loop() -> None:
    """Run a simulator together with its driver."""
    start("ds_driver.ros.closed_loop_node")


def camera_driver() -> None:
    """Run a network on another ROS stack."""
    start("ds_driver.ros.camera_driver_node")


def cmd_vel_adapter() -> None:
    """Run the adapter for drivers that know only standard messages."""
    start("ds_driver.ros.cmd_vel_adapter_node")
