# SPDX-License-Identifier: Apache-2.0
"""Runs the reference driver as a node, which steers by the lane state instead of images (paper, equation 1)."""

from __future__ import annotations

import sys
from dataclasses import asdict, replace
from functools import partial

from ds_interfaces.msg import VehicleState
from ds_interfaces.srv import GetSimulatorInfo
from rclpy.node import Node

from ds_driver.control.autopilot import ROWS_SEEN, Autopilot
from ds_driver.ros.simulator_client import Answer, SimulatorClient, SimulatorInfo
from ds_sim.ros.conversions import gains_of
from ds_sim.ros.diagnostics import AnswerDiagnostics
from ds_sim.ros.parameters import declare
from ds_sim.ros.runtime import run_node
from ds_sim.simulator import AutopilotGains, Command, SimulatorSpec

ASK = -1.0
"""Value of a gain parameter that asks the simulator."""
GAINS = (
    ("proportional", 0.0, 100.0, "On the lateral position, 1/m (K_P)"),
    ("derivative", 0.0, 100.0, "On its difference from frame to frame, 1/m (K_D)"),
    ("integral", 0.0, 100.0, "On its running sum, 1/m (K_I)"),
    ("max_speed", 1.0, 200.0, "Threshold and K = H of equation 2, km/h"),
    ("min_speed", 1.0, 200.0, "K = L of equation 2, km/h"),
)
"""Name, bounds and meaning of the gains of equations 1 and 2; the bounds catch typing errors."""


class AutopilotNode(Node):
    """Drives one or more simulators by the lateral position; asks them for the gains before each run."""

    def __init__(self) -> None:
        super().__init__("autopilot")
        self._namespaces = declare(self, "namespaces", [""], 'Namespaces of the simulators; "" is the node\'s own.')
        count, rest = len(self._namespaces), ", one for each namespace; -1 asks the simulator."
        columns = {
            name: declare(self, name, [ASK] * count, about + rest, low=ASK, high=high, length=count)
            for name, _, high, about in GAINS
        }
        for name, low, _, _ in GAINS:
            for value in columns[name]:
                if value != ASK and value < low:
                    raise ValueError(f"parameter {name} is {value}: expected at least {low:g}, or -1")
        self._given = [{name: values[i] for name, values in columns.items()} for i in range(count)]
        self._gains: list[AutopilotGains | None] = [None] * count
        purpose = "for the autopilot's gains (not needed if the gains are parameters)"
        self._info = SimulatorInfo(self, self._namespaces, purpose, self._on_info)
        self._simulators, answers = [], AnswerDiagnostics(self)
        for index, (namespace, geometry) in enumerate(zip(self._namespaces, self._given, strict=True)):
            on_start = partial(self._info.ask, index) if ASK in geometry.values() else None
            self._simulators.append(SimulatorClient(self, namespace, VehicleState, answers, on_start))
            if on_start is None:
                self._use(index, AutopilotGains(**geometry), "from parameters")
            else:
                on_start()
        names = ", ".join(filter(None, self._namespaces)) or self.get_namespace()
        self.get_logger().info(f"the autopilot drives {names}")

    def rows_seen(self, _spec: SimulatorSpec) -> tuple[int, int]:
        """Return first row and end of the rows that it looks at."""
        return ROWS_SEEN

    def _on_info(self, index: int, info: GetSimulatorInfo.Response) -> None:
        overrides = {name: value for name, value in self._given[index].items() if value != ASK}
        self._use(index, replace(gains_of(info), **overrides), f"from {info.name}")

    def _use(self, index: int, gains: AutopilotGains, source: str) -> None:
        """Drive a simulator with the given gains, and log them when they change."""
        if gains != self._gains[index]:
            name = self._namespaces[index] or self.get_namespace()
            shown = ", ".join(f"{key} {value:g}" for key, value in asdict(gains).items())
            self.get_logger().info(f"{name}: gains {source}: {shown}")
        self._gains[index] = gains
        self._simulators[index].drive_with(_pilot(gains))


def _pilot(gains: AutopilotGains) -> Answer:
    autopilot = Autopilot(gains)

    def answer(state: VehicleState) -> Command:
        nonlocal autopilot
        if state.step == 0:
            autopilot = Autopilot(gains)
        return autopilot.command(state.preview_lateral_position, state.speed)

    return answer


def main() -> None:
    """Run the autopilot until a signal stops it."""
    sys.exit(run_node(AutopilotNode))


if __name__ == "__main__":
    main()
