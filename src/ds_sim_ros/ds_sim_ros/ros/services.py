# SPDX-License-Identifier: Apache-2.0
"""Calls the services of another simulator: waits for them with a limit, checks their types, and reads refusals."""

from __future__ import annotations

import time
from importlib import import_module
from typing import Any

from rclpy.node import Node

from ds_sim.ros.node_thread import NodeThread
from ds_sim.simulator import SimulatorError

POLL = 0.02
"""Time between two looks at the ROS graph, s; chosen: discovery takes tenths of a second."""


class Services:
    """Services of one simulator, as one node sees them."""

    def __init__(self, node: Node, thread: NodeThread, timeout: float) -> None:
        self._node, self._thread, self._timeout = node, thread, timeout
        self._clients: dict[str, tuple[str, Any]] = {}

    def call(self, name: str, requests: dict[str, dict[str, Any]], *, repeatable: bool = True) -> None:
        """Call a service, by types that it may have -> fields of the request, until it has done what was asked.

        A request that is not answered may be sent again if it is repeatable. SimulatorError if there is no such
        service, if it does not answer within the limit, or if it refuses.
        """
        if name not in self._clients:
            self._clients[name] = self._client(name, list(requests))
        kind, client = self._clients[name]
        request = client.srv_type.Request(**requests[kind])
        if repeatable:
            answer = self._thread.ask(client, request, self._timeout)
        else:
            answer = self._thread.call(lambda: client.call_async(request), self._timeout)
        if answer is None:
            raise SimulatorError(f"{name} does not answer within {self._timeout:g} s: is the simulator running?")
        if reason := refusal(answer):
            raise SimulatorError(f"{name} refused the request ({reason}): see the simulator's own log")

    def _client(self, name: str, kinds: list[str]) -> tuple[str, Any]:
        deadline = time.monotonic() + self._timeout
        full, kind, client = self._node.resolve_service_name(name), "", None
        types: list[str] = []
        while time.monotonic() < deadline and not (client is not None and client.service_is_ready()):
            if client is None:
                types = dict(self._node.get_service_names_and_types()).get(full, [])
                if kind := next((one for one in kinds if one in types), ""):
                    client = self._node.create_client(interface(kind), name)
            self._thread.pause(POLL)
        if client is None:
            offered = f"{full} is of the type {', '.join(types)}" if types else f"there is no service {full}"
            raise SimulatorError(
                f"{offered} after {self._timeout:g} s, expected {' or '.join(kinds)}: start the simulator in this ROS "
                f"domain ({self._node.context.get_domain_id()}), or correct its file"
            )
        return kind, client


def interface(name: str) -> Any:
    """Import the class of a message or service, such as `std_srvs/srv/Trigger`."""
    package, folder, kind = name.split("/")
    try:
        return getattr(import_module(f"{package}.{folder}"), kind)
    except ImportError:
        raise SimulatorError(f"{package} is not installed: run ./ds setup, or install and source it") from None


def refusal(answer: Any) -> str:
    """Why a service did not do what was asked, in one line; "" if it did, or if its answer cannot say."""
    if hasattr(answer, "result"):
        done, text = answer.result.result == answer.result.RESULT_OK, answer.result.error_message
        text = text or f"result {answer.result.result}"
    elif hasattr(answer, "message"):
        done, text = getattr(answer, "success", False) or getattr(answer, "accepted", False), answer.message
    else:
        return ""
    return "" if done else " ".join(text.split()) or "no reason given"
