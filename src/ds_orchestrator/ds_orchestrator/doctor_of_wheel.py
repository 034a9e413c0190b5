"""Checks an installation of the wheel, which has no checkout: its libraries, and what else the machine needs."""

from __future__ import annotations

import re
import sys
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

from ds_orchestrator.doctor import Check, check_renderer, check_system, check_weights, look_up, module_of

WHEEL = "digital-siblings"


def diagnose_wheel(*, imports: bool = False) -> list[Check] | None:
    """Check the libraries that the wheel asks for; extras and ROS are optional.

    Args:
        imports: import every library instead of looking it up.

    Returns:
        The checks; None if no wheel is installed.
    """
    try:
        wanted = requires(WHEEL) or []
    except PackageNotFoundError:
        return None
    extras: dict[str, str] = {}
    needed = []
    for requirement in wanted:
        name = re.split(r"[^\w.-]", requirement, maxsplit=1)[0].lower()
        if extra := re.search(r"extra == ['\"](\w+)['\"]", requirement):
            extras[name] = extra[1]
        else:
            needed.append(name)
    modules = {name: module_of(name).replace("-", "_") for name in [*needed, *extras]}
    found = look_up(Path(sys.executable), {**modules, "rclpy": "rclpy"}, imports=imports)
    checks = [check_system()[0]]
    for name in needed:
        version, problem = found[name]
        fix = f"python -m pip install {WHEEL}" if problem else ""
        checks.append(Check(name, not problem, problem or version, fix))
    for name, group in extras.items():
        version, problem = found[name]
        absent = f"not installed; optional: python -m pip install '{WHEEL}[{group}]'"
        checks.append(Check(f"{name} (optional)", True, absent if problem else version, ""))
    version, problem = found["rclpy"]
    nodes = "not installed; optional: nodes and ds drive need ROS 2 and a built checkout (make setup)"
    checks.append(Check("ROS 2 (optional)", True, nodes if problem else f"rclpy {version}", ""))
    weights = check_weights(Path(__file__).parents[1] / "ds_driver/models/dave2.safetensors")
    if weights.fix:
        weights = weights._replace(fix="python -m pip install --force-reinstall --no-deps WHEEL.whl")
    return [*checks, check_renderer(), weights]
