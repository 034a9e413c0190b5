"""Starts this package's nodes so that Ctrl-C ends them at once, also while their libraries are being imported."""

from __future__ import annotations

from ds_sim.executables import start


def driver() -> None:
    """The network that drives simulators."""
    start("ds_driver.ros.driver_node")


def autopilot() -> None:
    """The reference driver."""
    start("ds_driver.ros.autopilot_node")


def camera_driver() -> None:
    """The network on someone's stack."""
    start("ds_driver.ros.camera_driver_node")


def cmd_vel_adapter() -> None:
    """Someone's driver on our simulators."""
    start("ds_driver.ros.cmd_vel_adapter_node")
