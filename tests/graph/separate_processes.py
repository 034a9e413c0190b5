# SPDX-License-Identifier: Apache-2.0
"""Simulators and drivers in processes of their own, as launch files start them."""

from __future__ import annotations

from ds_orchestrator.graph.supervisor import ProcessSpec
from ds_sim.registry import SimulatorName


def simulator_processes(namespaces: dict[SimulatorName, str], command_timeout: float) -> list[ProcessSpec]:
    """One process per simulator."""
    return [
        ProcessSpec(
            name=f"simulator_{namespace.strip('/')}",
            module="ds_sim.ros.simulator_node",
            namespace=namespace,
            parameters={"simulator": name, "command_timeout": command_timeout},
        )
        for name, namespace in namespaces.items()
    ]
