"""Which processes make up a graph: one node per simulator under its own namespace, and one driver for all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from ds_driver.closed_loop.simulation import AUTOPILOT
from ds_orchestrator.graph.supervisor import ProcessSpec
from ds_sim.registry import spec_of


def namespaces_of(siblings: Sequence[str], twin: str | None) -> dict[str, str]:
    """Simulator name -> namespace: /ds1, /ds2, ... for siblings in order, /twin for the twin."""
    spaces = {name: f"/ds{index}" for index, name in enumerate(siblings, start=1)}
    if twin:
        spaces[twin] = "/twin"
    return spaces


DRIVER_PROCESS = "driver"


def simulator_process_name(namespace: str) -> str:
    """What the process of the simulator in a namespace is called here, and its log."""
    return f"simulator_{namespace.strip('/').replace('/', '_')}"


def simulator_processes(namespaces: dict[str, str], command_timeout: float) -> list[ProcessSpec]:
    """One process per simulator."""
    return [
        ProcessSpec(
            name=simulator_process_name(namespace),
            module="ds_sim.ros.simulator_node",
            namespace=namespace,
            parameters={"simulator": name, "command_timeout": command_timeout},
        )
        for name, namespace in namespaces.items()
    ]


def driver_process(driver: str, namespaces: dict[str, str]) -> ProcessSpec:
    """The driver of all simulators: the autopilot with each vehicle's gains, or a network with each camera's crop."""
    specs = [spec_of(name) for name in namespaces]
    parameters: dict[str, object] = {"namespaces": list(namespaces.values())}
    if driver == AUTOPILOT:
        gains = [asdict(spec.autopilot) for spec in specs]
        parameters |= {key: [float(g[key]) for g in gains] for key in gains[0]}
        return ProcessSpec(name=DRIVER_PROCESS, module="ds_driver.ros.autopilot_node", parameters=parameters)
    parameters |= {
        "network": driver,
        "crop_top": [spec.crop_top for spec in specs],
        "crop_bottom": [spec.crop_bottom for spec in specs],
    }
    return ProcessSpec(name=DRIVER_PROCESS, module="ds_driver.ros.driver_node", parameters=parameters)


def check_driver(driver: str) -> None:
    """Find out before anything starts whether a driver can be had.

    Raises:
        ValueError: its name stands for nothing, or what it stands for cannot be used.
    """
    if driver != AUTOPILOT:
        from ds_driver.networks.network_driver import load_pilot

        load_pilot(driver)
