"""Whether nodes can be started here."""

from __future__ import annotations

from importlib.util import find_spec


class RosMissingError(RuntimeError):
    """ROS, or the workspace's messages, are not installed."""


def check_ros() -> None:
    """Check that ROS and the workspace's messages can be imported.

    Raises:
        RosMissingError: they cannot.
    """
    missing = [name for name in ("rclpy", "ds_interfaces") if find_spec(name) is None]
    if missing:
        raise RosMissingError(
            f"{' and '.join(missing)} not found: nodes need ROS 2 and a built checkout (make setup); "
            "campaigns, suites and comparisons run without them by --engine local"
        )
