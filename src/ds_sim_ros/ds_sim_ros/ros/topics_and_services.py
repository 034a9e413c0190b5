# SPDX-License-Identifier: Apache-2.0
"""Hears the topics of another simulator and calls its services, each with a limit of time."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from rclpy.node import Node

from ds_sim.ros.node_thread import NodeThread
from ds_sim.simulator import SimulatorError

POLL = 0.02
"""Time between two looks at the ROS graph, s; chosen: discovery takes tenths of a second."""
MOST = 200
"""Messages that are kept; chosen: a frame of a simulator that publishes 4000 times a second."""


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


@dataclass(frozen=True, slots=True)
class Received:
    """A message, the stamp of its header, ns, and its arrival by the monotonic clock, s."""

    stamp: int
    arrived: float
    message: Any


class Inbox:
    """Keeps the newest messages of one topic."""

    def __init__(self) -> None:
        self._messages: deque[Received] = deque(maxlen=MOST)
        self._changed = threading.Condition()

    def put(self, message: Any) -> None:
        """Add a message; called by the node's thread."""
        stamp = message.header.stamp
        received = Received(stamp.sec * 10**9 + stamp.nanosec, time.monotonic(), message)
        with self._changed:
            self._messages.append(received)
            self._changed.notify_all()

    def clear(self) -> None:
        """Forget all messages."""
        with self._changed:
            self._messages.clear()

    @property
    def newest(self) -> Received | None:
        """The last message to arrive."""
        with self._changed:
            return self._messages[-1] if self._messages else None

    def wait(self, stamp: int, deadline: float) -> Received | None:
        """Return the first message with a stamp (ns) or a later one; None at a deadline of the monotonic clock, s."""

        def found() -> Received | None:
            return next((one for one in self._messages if one.stamp >= stamp), None)

        with self._changed:
            return self._changed.wait_for(found, max(0.0, deadline - time.monotonic()))


Pair = tuple[Received, Received]
"""Odometry and image."""


class Topics:
    """The two topics that a frame is made of."""

    def __init__(self, odometry: Inbox, image: Inbox, names: tuple[str, str], timeout: float) -> None:
        self.inboxes, self._names, self._timeout = (odometry, image), names, timeout

    @property
    def deadline(self) -> float:
        """Until when to wait that begins now, s of the monotonic clock."""
        return time.monotonic() + self._timeout

    def clear(self) -> None:
        """Forget all messages."""
        for inbox in self.inboxes:
            inbox.clear()

    def newest(self) -> Pair | None:
        """The last messages to arrive; None until both topics have one."""
        odometry, image = (inbox.newest for inbox in self.inboxes)
        return None if odometry is None or image is None else (odometry, image)

    def wait(self, odometry: int, image: int) -> Pair:
        """Wait for the first messages with these stamps, ns, or later ones."""
        deadline, arrived = self.deadline, []
        for name, inbox, stamp in zip(self._names, self.inboxes, (odometry, image), strict=True):
            received = inbox.wait(stamp, deadline)
            if received is None:
                raise self.missing(f"stamped {stamp / 1e9:.3f} s or later", name)
            arrived.append(received)
        return arrived[0], arrived[1]

    def settled(self, is_settled: Callable[[Received, Received], bool], poll: float, after: str) -> Pair:
        """Newest messages once they fulfil a condition, looked at every so often, or when time is up."""
        deadline, newest = self.deadline, None
        while time.monotonic() < deadline:
            time.sleep(poll)
            newest = self.newest()
            if newest is not None and is_settled(*newest):
                break
        if newest is None:
            raise self.missing(f"after {after}")
        return newest

    def missing(self, what: str, name: str = "") -> SimulatorError:
        """Error of a message that does not come, of a topic or the first silent one."""
        silent = [one for one, inbox in zip(self._names, self.inboxes, strict=True) if inbox.newest is None]
        name = name or (silent or list(self._names))[0]
        newest = self.inboxes[self._names.index(name)].newest
        state = "none came" if newest is None else f"the newest has {newest.stamp / 1e9:.3f} s"
        return SimulatorError(
            f"{name}: no message {what} within {self._timeout:g} s, {state}: the simulator hangs, or does not publish "
            "at the end of each frame of 1/20 s with stamps of simulated time"
        )
