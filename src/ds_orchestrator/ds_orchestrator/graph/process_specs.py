"""Processes of a graph: a simulator and a driver together for each namespace, or one by one."""

from __future__ import annotations

from ds_driver.control.autopilot import AUTOPILOT
from ds_orchestrator.graph.supervisor import ProcessSpec

DRIVER_PROCESS = "driver"


def simulator_process_name(namespace: str) -> str:
    """Name the process, and its log, of the simulator in a namespace."""
    return f"simulator_{namespace.strip('/').replace('/', '_')}"


def closed_loop_process_name(namespace: str) -> str:
    """Name the process, and its log, of the simulator in a namespace together with its driver."""
    return f"closed_loop_{namespace.strip('/').replace('/', '_')}"


def closed_loop_processes(
    driver: str, namespaces: dict[str, str], command_timeout: float, *, draw: str = "all"
) -> list[ProcessSpec]:
    """Specify one process per simulator, with a driver's node beside the simulator's.

    Args:
        driver: name of the driver.
        namespaces: simulator name -> namespace.
        command_timeout: wall-clock time that a simulator waits for its driver, s.
        draw: `all`, or `seen` for the rows of the images that the driver sees.
    """
    return [
        ProcessSpec(
            name=closed_loop_process_name(namespace),
            module="ds_driver.ros.closed_loop_node",
            arguments=("autopilot",) if driver == AUTOPILOT else ("driver",),
            namespace=namespace,
            parameters={"simulator": name, "command_timeout": command_timeout, "draw": draw}
            | ({} if driver == AUTOPILOT else {"network": driver}),
        )
        for name, namespace in namespaces.items()
    ]


def simulator_processes(namespaces: dict[str, str], command_timeout: float) -> list[ProcessSpec]:
    """Specify one process per simulator."""
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
    """Specify the driver of all simulators; it asks each for its crop, or for the gains of its vehicle."""
    parameters: dict[str, object] = {"namespaces": list(namespaces.values())}
    if driver == AUTOPILOT:
        return ProcessSpec(name=DRIVER_PROCESS, module="ds_driver.ros.autopilot_node", parameters=parameters)
    parameters["network"] = driver
    return ProcessSpec(name=DRIVER_PROCESS, module="ds_driver.ros.driver_node", parameters=parameters)
